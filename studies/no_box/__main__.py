"""Does a posterior get found from a wide prior, wherever the truth is?

Truths are drawn from the wide prior itself, so that half of them and more lie outside of the range
that the scene names; FEM makes the data. ``infer`` finds the posterior by rounds of FEM runs and
makes an emulator of them; FEM checks it with runs of its own. Counted are runs, seconds, verdicts,
truths inside 90 % intervals, and how far FEM would move a mean.

    python -m studies.no_box [--quick]
"""

import json
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from studies.common.figures import pyplot
from studies.common.output import Case, Results, parser
from studies.common.twins import wide_theta

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 83
VENTRICLE = """
mesh = "ventricle.vtu"
law = "holzapfel_ogden"
order = 2
loads = [{kind = "cavity_pressure", facet_set = "endocardium"}]
supports = [{node_set = "base"}]
[fibres]
rule = "helix"
angles = [60.0, -60.0]
endocardium = "endocardium"
epicardium = "epicardium"
[constants]
kappa = 25.0
[parameters]
a = {unit = "kPa", range = [0.2, 0.52], scale = "log"}
b = {unit = "", range = [1.0, 4.2], scale = "log"}
a_f = {unit = "kPa", range = [3.0, 10.36], scale = "log"}
b_f = {unit = "", range = [1.0, 4.46], scale = "log"}
pressure = {unit = "kPa", range = [0.53, 1.33]}
"""


@dataclass(frozen=True)
class Body:
    """What is measured of one body.

    scene : a built-in scene; None for the coarse ventricle of 615 nodes.
    observe, noise, known : as in an experiment file.
    """

    scene: str | None
    observe: str
    noise: dict[str, float]
    known: dict[str, float] = field(default_factory=dict)


BODIES = {
    "beam": Body("once_clamped_beam", "nodes:20", {"displacement": 0.2}),
    "twisting cube": Body("twisting_cube", "nodes:20", {"displacement": 0.05}),
    "liver": Body("liver", "nodes:20", {"displacement": 0.5}),
    "ventricle": Body(
        None, "volume", {"volume": 1.0}, known={f"pressure@p{k}": 0.4 * k for k in (1, 2, 3)}
    ),
    "ventricle, pressure unknown": Body(
        None, "landmarks:24+volume", {"volume": 1.0, "displacement": 0.2}
    ),
}


def one(name: str, number: int) -> dict[str, Any]:
    """One data set of the body called ``name``, to its verdict."""
    body, begin = BODIES[name], time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "ventricle.toml"
        if body.scene is None:
            file.write_text(VENTRICLE)
            mesh = em.generators.human_ventricle(rings=5, around=12, layers=1, order=2)
            em.write_mesh(file.with_suffix(".vtu"), mesh)
        scene = em.find_scene(body.scene or str(file))
        known = {parameter.split("@")[0] for parameter in body.known}
        drawn = wide_theta(scene, np.random.default_rng([SEED, number]))
        truth = {n: value for n, value in drawn.items() if n not in known}
        ranges = {p.name: (p.low, p.high) for p in scene.parameters}
        outside = sorted(n for n, v in truth.items() if not ranges[n][0] <= v <= ranges[n][1])
        words = {"truth": truth, "noise": body.noise, "known": body.known}
        lines = [f"scene = '{body.scene or file}'", f'observe = "{body.observe}"']
        lines += ['forward = "rounds"', f"seed = {SEED + number}"]
        for entry, values in words.items():
            lines += [f"[{entry}]", *(f'"{n}" = {value!r}' for n, value in values.items())]
        experiment = Path(folder) / "experiment.toml"
        experiment.write_text("\n".join(lines))
        posterior = cal.infer(cal.read_experiment(experiment), check_map=False)
    searched = time.perf_counter() - begin
    certificate = cal.certify(posterior, em.Simulator(posterior.model.forward.scene), mesh=0)
    rounds = json.loads(posterior.tree.attrs["rounds"])
    table = posterior.summary(0.9)
    return {
        "status": certificate.verdict,
        "reason": certificate.reason,
        "truth": truth,
        "outside": outside,
        "inside_90": {n: table[n]["low"] <= v <= table[n]["high"] for n, v in truth.items()},
        "runs": rounds[-1]["runs"],
        "failed": rounds[-1]["failed"],
        "missed": rounds[-1]["missed"],
        "certificate_runs": certificate.to_json()["draws"],
        "largest_shift": max(abs(s) for s in certificate.shift.values()),
        "seconds": [searched, time.perf_counter() - begin],
    }


def conclude(cases: list[Case]) -> dict[str, Any]:
    """Sums over all data sets."""
    inside = [hit for case in cases for hit in case["inside_90"].values()]
    return {
        "data_sets": len(cases),
        "with_a_truth_outside": sum(bool(case["outside"]) for case in cases),
        "accepted": sum(case["status"] == "accepted" for case in cases),
        "inside_90": [sum(inside), len(inside)],
        "median_runs": float(np.median([case["runs"] for case in cases])),
        "largest_shift": max(case["largest_shift"] for case in cases),
    }


def draw(cases: list[Case], path: Path) -> None:
    """Runs until FEM was foreseen, by body; filled where a truth is outside of the range."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
    for row, body in enumerate(BODIES):
        mine = [case for case in cases if case["name"].rsplit(" ", 1)[0] == body]
        for k, case in enumerate(mine):
            accepted = case["status"] == "accepted"
            axes.plot(
                case["runs"], row + 0.05 * (k - len(mine) / 2), "o",
                color="tab:blue" if accepted else "tab:red",
                mfc=None if case["outside"] else "white",
            )  # fmt: skip
    axes.set(
        yticks=range(len(BODIES)), yticklabels=list(BODIES), xlabel="FEM runs of the rounds",
    )  # fmt: skip
    figure.suptitle("filled: a truth outside of the scene's range; red: not accepted", fontsize=10)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main() -> None:
    words = parser(__doc__, HERE)
    words.add_argument("--sets", type=int, default=10, help="data sets of each body")
    arguments = words.parse_args()
    results = Results(arguments.out, SEED, again=arguments.again)
    for number in range(1 if arguments.quick else arguments.sets):
        for name in BODIES:
            results.case(f"{name} {number}", lambda b=name, n=number: one(b, n))
    cases = results.cases
    summary = conclude(cases)
    results.write(summary=summary)
    draw(cases, arguments.out / "runs.png")
    print(summary)
    inside, of = summary["inside_90"]
    assert arguments.quick or 0.8 * of <= inside <= 0.97 * of
    assert all(case["status"] != "accepted" or case["largest_shift"] < 0.25 for case in cases)


if __name__ == "__main__":
    main()
