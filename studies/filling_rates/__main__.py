"""Twins of a ventricle that relaxes, filled at two rates: are their intervals right?

    python -m studies.filling_rates [--quick]

Twenty truths are drawn from the prior, volumes get noise, and each twin is calibrated by the loop
without a box and certified by fresh runs of the same finite elements. Writes results.json and
filling_rates.png.
"""

import csv
import tempfile
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
from studies.common.figures import BLUE, GREEN, ORANGE, pyplot
from studies.common.output import Case, Results, parser, run, save
from studies.common.processes import calibrate

import emulator as em

HERE = Path(__file__).parent
TWINS, QUICK = 20, 1
NOISE = 0.3  # mL
PRESSURE = 1.2  # kPa
RATES = {"fast": 0.2, "slow": 4.0}  # s until the pressure is there
HELD = (0.25, 1.0, 2.5)  # s after that, at which the volume is seen, too
LOG_NORMAL = {"a": (0.32, 0.4, "kPa"), "a_f": (5.6, 0.4, "kPa"), "tau_1": (1.0, 0.7, "s")}
RELAXED = (0.05, 0.95)
UNKNOWNS = ("a", "a_f", "relaxation_1", "tau_1")
SCENE = """law = "holzapfel_ogden"
mesh = "ventricle.vtu"
history = "filling.csv"
viscosity = {kind = "prony"}
constants = {b = 2.6, b_f = 2.73, kappa = 25.0}
supports = [{node_set = "base"}]
loads = [{kind = "cavity_pressure", facet_set = "endocardium"}]
"""


def filling(rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Times in s and pressures in kPa of one filling, and of what is held after it."""
    times = np.append(np.linspace(0.2, 1.0, 5) * rate, rate + np.array(HELD))
    return times, PRESSURE * np.minimum(times / rate, 1.0)


def problem(folder: Path) -> Path:
    """The scene file, beside its mesh and its history."""
    ventricle = em.scenes.left_ventricle(rings=4, around=8, layers=1, order=1)
    em.write_mesh(folder / "ventricle.vtu", ventricle.mesh, ventricle.fibres)
    rows = [
        (name, time, pressure)
        for name, rate in RATES.items()
        for time, pressure in zip(*filling(rate), strict=True)
    ]
    with (folder / "filling.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("protocol", "time [s]", "pressure [kPa]"), *rows])
    lines = [SCENE, "[parameters]", f"relaxation_1 = {{range = {list(RELAXED)}}}"]
    for name, (median, log_sd, unit) in LOG_NORMAL.items():
        lines.append(f'{name} = {{unit = "{unit}", median = {median}, log_sd = {log_sd}}}')
    (folder / "filling.toml").write_text("\n".join(lines))
    return folder / "filling.toml"


def truth_of(seed: int) -> dict[str, float]:
    """A draw of the prior."""
    rng = np.random.default_rng([seed, 88])
    drawn = {n: m * np.exp(sd * rng.normal()) for n, (m, sd, _) in LOG_NORMAL.items()}
    drawn["relaxation_1"] = rng.uniform(*RELAXED)
    return {name: float(f"{drawn[name]:.4g}") for name in UNKNOWNS}


def twin(seed: int) -> Case:
    """The posterior and verdict of one twin, and in which intervals its truth is."""
    truth, begin = truth_of(seed), perf_counter()
    with tempfile.TemporaryDirectory() as place:
        words = [problem(Path(place)).name, "--truth", *(f"{n}={v}" for n, v in truth.items())]
        words += ["--observe", "volume", "--noise", f"volume={NOISE}", "--seed", str(seed)]
        words += ["--bounded", "relaxation_1", "--no-certify", "--out", "run"]
        calibrate(Path(place), "infer", *words)
        told = calibrate(Path(place), "certify", "run", "--no-mesh")  # data are of this mesh
        with (Path(place) / "run" / "data.csv").open() as file:
            volumes = [float(row["volume"]) for row in csv.DictReader(file)]
    rows = {name: told["parameters"][name] for name in truth}
    return {
        "volumes": volumes,
        "truth": truth,
        "mean": {name: row["mean"] for name, row in rows.items()},
        "sd": {name: row["sd"] for name, row in rows.items()},
        "inside": {n: row["low"] <= truth[n] <= row["high"] for n, row in rows.items()},
        "verdict": told["verdict"],
        "runs": told["rounds"][-1]["runs"],
        "seconds": round(perf_counter() - begin, 1),
    }


def draw(cases: list[Case], path: Path) -> None:
    """Volumes of one body at both rates, and each twin's estimates over its truths."""
    figure, axes = pyplot().subplots(1, 3, figsize=(12.0, 3.8), layout="constrained")
    volumes = iter(cases[0]["volumes"])
    for rate, colour in zip(RATES.values(), (BLUE, ORANGE), strict=True):
        times, _ = filling(rate)
        seen = [next(volumes) for _ in times]
        axes[0].plot(times, seen, "o-", color=colour, ms=4, label=f"filled in {rate:g} s")
    axes[0].set(xlabel="time (s)", ylabel="volume (mL)", xscale="log", title="a twin, with noise")
    axes[0].legend()
    for axis, name in zip(axes[1:], ("relaxation_1", "tau_1"), strict=True):
        for case in cases:
            colour = GREEN if case["inside"][name] else ORANGE
            at, half = case["truth"][name], 1.645 * case["sd"][name]
            mean = case["mean"][name]
            axis.plot([at, at], [max(mean - half, 1e-3), mean + half], color=colour, lw=1)
            axis.plot(at, mean, "o", color=colour, ms=4)
        axis.axline((0.5, 0.5), slope=1.0, color="0.6", lw=1, zorder=0)
        axis.set(xlabel=f"{name}, truth", ylabel="mean and 90 %", title=name)
    axes[2].set(xscale="log", yscale="log", ylim=(0.1, 6.0))
    for along in (axes[2].xaxis, axes[2].yaxis):
        along.set_minor_formatter("")
    save(figure, path)


def main() -> None:
    """Run the study."""
    arguments = parser(__doc__, HERE).parse_args()
    results = Results(arguments.out, 0, again=arguments.again)
    for seed in range(QUICK if arguments.quick else TWINS):
        results.case(f"twin {seed}", partial(twin, seed))
    cases = results.cases
    inside = [yes for case in cases for yes in case["inside"].values()]
    accepted = sum(case["verdict"] == "accepted" for case in cases)
    print(f"{sum(inside)} of {len(inside)} inside their 90 %; {accepted} of {len(cases)} accepted")
    results.write()
    draw(cases, arguments.out / "filling_rates.png")


if __name__ == "__main__":
    run(main)
