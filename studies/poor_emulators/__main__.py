"""Does the map's own error in the likelihood widen a poor emulator's posterior, or move it?

    python -m studies.poor_emulators
    python -m studies.poor_emulators --meshes coarse default --out DIR
    python -m studies.poor_emulators --quick --out DIR

Emulators of a left ventricle from 1, 5 and 20 FEM runs infer data sets made by FEM, once as if they
were exact (``error_runs`` 0) and once with their error learned from 24 FEM runs. Their posteriors
are compared with FEM's: draws of a good emulator's posterior, weighted by FEM. Writes results.json
and poor_emulators.png.
"""

import argparse
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from studies.common.output import save, study_header

import calibrate as cal
from calibrate.figures import pyplot
from calibrate.measurements import parse_observation
from calibrate.samplers import NUTSOptions
from calibrate.statistical_model import FEMLikelihood, with_error
from emulator.core.store import write_json
from emulator.fem import Simulator, design, run_campaign, sobol
from emulator.scenes.built_in.ventricles import left_ventricle
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.taylor import expand
from emulator.training.mechanics import add_discrepancy

HERE = Path(__file__).parent
SEED = 7
OBSERVE = "landmarks:24+volume"
NOISE = {"displacement": 0.3, "volume": 1.0}  # mm, mL
ERROR_RUNS = 24
GOOD = 200  # FEM runs of the emulator that FEM's weights begin from
LEVEL = 0.9
MESHES = {"coarse": (4, 8, 1), "default": None}
# Order of the Taylor series and FEM runs, the centre's included.
POOR = {"1 run, 1st order": (1, 1), "1 run": (3, 1), "5 runs": (3, 5), "20 runs": (3, 20)}
OPTIONS = NUTSOptions(warmup=250, draws=300, chains=2, rounds=3, r_hat=1.02, ess=150.0)
QUICK = NUTSOptions(warmup=100, draws=100, chains=2, rounds=1)


class Moments(NamedTuple):
    """Of a posterior, by unknown: mean, sd, and the ends of the central interval, (p,) each."""

    mean: np.ndarray
    sd: np.ndarray
    low: np.ndarray
    high: np.ndarray


def scene_of(shape: tuple[int, int, int] | None) -> Scene:
    """The left ventricle of linear elements, on its own mesh or on one of ``shape``.

    That is rings, around, layers.
    """
    return left_ventricle(*(shape or ()), order=1)


def emulators(simulator: Simulator, wanted: list[tuple[int, int]]) -> dict[Any, Emulator]:
    """Emulators by (order of the series, FEM runs); all from the first of the same runs."""
    scene = simulator.scene
    series = expand(simulator, order=max(order for order, _ in wanted))
    more = design(scene, max(max(count for _, count in wanted) - 1, 1), SEED)
    thetas = jnp.concatenate([scene.centre[None], more])
    runs = run_campaign(simulator, thetas, sensitivities=True, predictor=series)
    found: dict[Any, Emulator] = {}
    for order, count in wanted:
        kept = np.sum(np.asarray(series.indices) >= 0, axis=1) <= order
        indices, derivatives = series.indices[kept], series.derivatives[kept]
        bare = Emulator(scene, taylor=replace(series, indices=indices, derivatives=derivatives))
        some = runs.take(slice(count))
        found[order, count] = bare if count == 1 else add_discrepancy(bare, some)[0]
    return found


def data_sets(simulator: Simulator, model: cal.Model, count: int) -> list[tuple[Any, Any, Any]]:
    """Theta, FEM's data without noise and with it, by the observation's name."""
    found = []
    for k, theta in enumerate(sobol(simulator.scene, count, SEED + 1)):
        field = simulator.solve(theta).require_converged(f"data set {k}").displacement
        means = model.observe(field[model.observe.nodes][None], theta[None])
        rng = np.random.default_rng([SEED, k])
        noisy = {n: np.asarray(m) + rng.normal(0.0, NOISE[n], m.shape) for n, m in means.items()}
        found.append((np.asarray(theta), means, noisy))
    return found


def moments(posterior: cal.Posterior) -> Moments:
    """Moments of a posterior's draws."""
    draws = np.stack(list(posterior.draws().values()), axis=1)
    low, high = np.quantile(draws, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL], axis=0)
    return Moments(draws.mean(axis=0), draws.std(axis=0), low, high)


def weighted(posterior: cal.Posterior, fem: FEMLikelihood, count: int) -> tuple[Moments, float]:
    """Moments with FEM's weights, and the share of effective ones among ``count`` weights.

    The weights of some draws correct the moments of all: (weighted - plain) is added.
    """
    plain, draws = moments(posterior), posterior.draws()
    rows = np.linspace(0, len(next(iter(draws.values()))) - 1, count).astype(int)
    some = [{name: float(values[row]) for name, values in draws.items()} for row in rows]
    both = [fem(draw, posterior.data) for draw in some]
    log = np.array([found.fem - found.cheap for found in both])
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    x = np.array([list(draw.values()) for draw in some])
    mean = weights @ x
    sd = np.sqrt(weights @ (x - mean) ** 2)
    shift = mean - x.mean(axis=0)
    exact = Moments(
        plain.mean + shift, plain.sd * sd / x.std(axis=0), plain.low + shift, plain.high + shift
    )
    return exact, float(1.0 / np.sum(weights**2) / count)


def size(model: cal.Model, theta: np.ndarray, means: Any) -> float:
    """The map's error at ``theta`` in sd of the noise, root mean square over the data."""
    predicted, _ = model.predict(dict(zip(model.states.unknowns, theta, strict=True)))
    each = [np.ravel((means[n] - predicted[n]) / NOISE[n]) for n in means]
    return float(np.sqrt(np.mean(np.concatenate(each) ** 2)))


def compare(name: str, mesh: str, found: list[Moments], exact: list[Moments], truths: np.ndarray):
    """Shifts in sd of the exact posterior, widths and coverage of one emulator's posteriors."""
    shifts = np.array([(f.mean - e.mean) / e.sd for f, e in zip(found, exact, strict=True)])
    widths = np.array([f.sd / e.sd for f, e in zip(found, exact, strict=True)])
    own = np.array([(f.mean - e.mean) / f.sd for f, e in zip(found, exact, strict=True)])
    inside = [(f.low <= t) & (t <= f.high) for f, t in zip(found, truths, strict=True)]
    return {
        "name": f"{mesh}, {name}",
        "status": "done",
        "mesh": mesh,
        "shift_rms": float(np.sqrt(np.mean(shifts**2))),
        "shift_largest": float(np.abs(shifts).max()),
        "shift_in_own_sd_rms": float(np.sqrt(np.mean(own**2))),
        "width_median": float(np.median(widths)),
        "covered": int(np.sum(inside)),
        "of": int(truths.size),
        "shifts": shifts.tolist(),
    }


def study(mesh: str, quick: bool, sets: int) -> list[dict[str, Any]]:
    """A row for FEM's posteriors, and two for each poor emulator."""
    options = QUICK if quick else OPTIONS
    simulator = Simulator(scene_of(MESHES[mesh]))
    scene = simulator.scene
    poor = {k: v for k, v in POOR.items() if not quick or k == "1 run, 1st order"}
    order = 2 if quick else max(v[0] for v in poor.values())
    good = (order, 20 if quick else GOOD)
    made = emulators(simulator, [good, *poor.values()])
    observe = parse_observation(scene, OBSERVE, SEED)
    noise = {name: cal.GaussianNoise(sd=sd) for name, sd in NOISE.items()}
    build = partial(cal.model, observe=observe, noise=noise)
    reference = build(made[good].cache())
    sets_ = data_sets(simulator, reference, sets)
    truths = np.array([theta for theta, _, _ in sets_])

    def posteriors(model: cal.Model) -> list[cal.Posterior]:
        return [
            cal.sample(model, data, options=options, seed=SEED + k, predictions=False)
            for k, (_, _, data) in enumerate(sets_)
        ]

    begin = time.process_time()
    fem, every = FEMLikelihood(reference, simulator), posteriors(reference)
    exact, effective = zip(*(weighted(p, fem, 20 if quick else 200) for p in every), strict=True)
    rows = [compare("FEM", mesh, list(exact), list(exact), truths)]
    plain = compare("FEM", mesh, [moments(p) for p in every], list(exact), truths)
    rows[0] |= {
        "kind": "fem",
        "nodes": len(scene.mesh.nodes),
        "emulator_runs": good[1],
        "effective_weights": min(effective),
        "emulator_shift_rms": plain["shift_rms"],
    }
    report(rows[0], begin)
    for name, key in poor.items():
        model = build(made[key].cache())
        sizes = [size(model, theta, means) for theta, means, _ in sets_]
        for runs in (0, ERROR_RUNS):
            begin = time.process_time()
            # The data passed the check under the reference; a poor map must not refuse it.
            chosen = replace(model, check_scale=False)
            if runs:
                chosen = with_error(chosen, simulator, runs, seed=SEED)
            found = posteriors(chosen)
            words = f"{name}, {'error learned' if runs else 'taken as exact'}"
            row = compare(words, mesh, [moments(p) for p in found], list(exact), truths)
            row |= {
                "kind": "poor",
                "emulator": name,
                "error_runs": runs,
                "map_error_in_noise_sd": sizes,
                "r_hat": max(r["r_hat"] for p in found for r in p.summary().values()),
                "divergences": sum(p.divergences for p in found),
            }
            rows.append(row)
            report(row, begin)
    return rows


def report(row: dict[str, Any], begin: float) -> None:
    row["processor_s"] = round(time.process_time() - begin, 1)
    print(
        f"{row['name']:42s} shift {row['shift_rms']:7.2f} sd (largest {row['shift_largest']:.1f}), "
        f"width {row['width_median']:.2f}, covered {row['covered']}/{row['of']}, "
        f"{row['processor_s']:.0f} s",
        flush=True,
    )


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Shifts of every posterior mean, in FEM's sd and in the posterior's own; coverage beside."""
    plt = pyplot()
    poor = [row for row in rows if row["kind"] == "poor"]
    names = list(dict.fromkeys((row["mesh"], row["emulator"]) for row in poor))
    figure, (left, middle, right) = plt.subplots(
        1, 3, figsize=(12, 1.8 + 0.5 * len(names)), width_ratios=(2, 1, 1), sharey=True,
        layout="constrained",
    )  # fmt: skip
    styles = {
        0: ("tab:red", "o", -0.16, "taken as exact"),
        ERROR_RUNS: ("tab:blue", "^", 0.16, f"error learned from {ERROR_RUNS} FEM runs"),
    }
    for row in poor:
        colour, marker, off, label = styles[row["error_runs"]]
        y = names.index((row["mesh"], row["emulator"])) + off
        shifts = np.abs(np.ravel(row["shifts"]))
        words = label if y == off else None
        left.plot(shifts, np.full(shifts.size, y), marker, color=colour, ms=4, alpha=0.4, mew=0)
        left.plot(row["shift_rms"], y, marker, color=colour, ms=9, mec="black", label=words)
        middle.barh(y, row["shift_in_own_sd_rms"], 0.28, color=colour)
        right.barh(y, 100.0 * row["covered"] / row["of"], 0.28, color=colour)
    fem = [100.0 * row["covered"] / row["of"] for row in rows if row["kind"] == "fem"]
    left.set(xscale="log", xlabel="|shift| of a mean, in FEM's posterior sd (large: rms)")
    left.set_yticks(range(len(names)), [f"{mesh}, {name}" for mesh, name in names])
    left.invert_yaxis()
    middle.set_xlabel("rms shift, in the posterior's own sd")
    right.set(xlabel="truths in the 90 % interval, %", xlim=(0, 100))
    for share in fem:
        right.axvline(share, color="black", lw=1.2, ls="--")
    right.set_title("dashed: FEM's own posteriors", fontsize=9)
    figure.legend(frameon=False, loc="outside upper left", ncols=2, fontsize=9)
    save(figure, path)


def check(rows: list[dict[str, Any]]) -> None:
    """What the README says."""
    by = {(row["mesh"], row.get("emulator"), row.get("error_runs")): row for row in rows}
    for mesh in {row["mesh"] for row in rows}:
        for name in POOR:
            learned, taken = by[mesh, name, ERROR_RUNS], by[mesh, name, 0]
            assert learned["shift_in_own_sd_rms"] < 1.0, learned["name"]
            if taken["shift_in_own_sd_rms"] > 1.0:
                assert learned["shift_in_own_sd_rms"] < 0.5 * taken["shift_in_own_sd_rms"]
                assert learned["covered"] >= taken["covered"], learned["name"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", nargs="+", default=["coarse"], choices=list(MESHES))
    parser.add_argument("--sets", type=int, default=5, help="data sets")
    parser.add_argument("--quick", action="store_true", help="one emulator, two data sets")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    meshes = ["coarse"] if arguments.quick else arguments.meshes
    rows: list[dict[str, Any]] = []
    for mesh in meshes:
        rows += study(mesh, arguments.quick, 2 if arguments.quick else arguments.sets)
        # Each mesh is kept before the next one begins.
        write_json(arguments.out / "results.json", {**study_header(HERE, SEED), "cases": rows})
    draw(rows, arguments.out / "poor_emulators.png")
    if not arguments.quick:
        check(rows)


if __name__ == "__main__":
    main()
