"""What accuracy costs in time on the once-clamped beam: FEM, emulator, polish, reduced model.

Run from anywhere: ``python -m studies.accuracy_vs_time``. Writes results.json and pareto.png
beside itself and asserts what the README of the study says.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import save
from studies.common.timing import per_call, unseen

from calibrate.figures.drawing import pyplot
from calibrate.observations import spread_nodes
from calibrate.provenance import study_header
from emulator import Simulator, load
from emulator.error.comparison import quantiles
from emulator.fem import run_campaign, sobol
from emulator.store import write_json
from emulator.surrogates.corrected import corrected
from emulator.surrogates.fem import fem_forward
from emulator.surrogates.pod_gp import fit_reduced
from emulator.surrogates.protocol import ForwardMap

HERE = Path(__file__).parent
SEED = 4


def measure(
    name: str,
    forward: ForwardMap,
    tests: jax.Array,
    reference: jax.Array,
    offline: float,
    fem_runs: int,
) -> dict[str, Any]:
    """Error at the nodes ``forward`` returns, time of a value and of a value with gradient."""
    value = jax.jit(lambda theta: forward(theta))
    # A sampler needs one scalar and its gradient in theta.
    gradient = jax.jit(jax.value_and_grad(lambda theta: jnp.sum(forward(theta) ** 2)))
    error = jnp.stack([value(theta) for theta in tests]) - reference[:, forward.nodes]
    case = {
        "name": name,
        "status": "done",
        "nodes": len(forward.nodes),
        "fem_runs": fem_runs,
        "err_u_mm": quantiles(jnp.sqrt(jnp.sum(error**2, axis=-1))),
        "value_s": per_call(value, unseen(forward.scene, len(tests))),
        "gradient_s": per_call(gradient, unseen(forward.scene, len(tests))),
        "offline_s": offline,
    }
    print(
        f"{name:38s} err_u median {case['err_u_mm']['median']:.2e} mm   "
        f"value {1e3 * case['value_s']:8.3f} ms   gradient {1e3 * case['gradient_s']:8.3f} ms   "
        f"offline {offline:7.1f} s",
        flush=True,
    )
    return case


def study(count: int) -> list[dict[str, Any]]:
    """Every method at ``count`` theta that none was fitted to."""
    trained = load("once_clamped_beam")
    scene, cached = trained.scene, trained.cache()
    simulator = Simulator(scene)
    tests = sobol(scene, count, seed=90_210)
    # The reference is FEM taken two Newton steps beyond its own tolerance.
    exact = corrected(fem_forward(simulator), simulator, steps=2)
    reference = jnp.stack([jax.jit(exact)(theta) for theta in tests])
    observed = spread_nodes(scene, 20, SEED)
    seconds = float(trained.record["seconds"])
    runs_used = trained.record["plan"]["simulations"] + 1
    cases = [
        measure("FEM from rest", fem_forward(simulator), tests, reference, 0.0, 0),
        measure(
            "FEM started by the emulator",
            fem_forward(simulator, start=cached),
            tests,
            reference,
            seconds,
            runs_used,
        ),
        measure("emulator, full field", cached, tests, reference, seconds, runs_used),
        measure(
            "emulator, 20 observed nodes", cached.at(observed), tests, reference, seconds, runs_used
        ),
        measure(
            "emulator + 1 Newton step",
            corrected(cached, simulator, steps=1),
            tests,
            reference,
            seconds,
            runs_used,
        ),
    ]
    for runs in (10, 30, 60):
        begin = time.perf_counter()
        campaign = run_campaign(simulator, sobol(scene, runs, SEED))
        reduced = fit_reduced(scene, campaign)
        offline = time.perf_counter() - begin
        cases.append(
            measure(f"POD + GP, {runs} FEM runs", reduced, tests, reference, offline, runs)
        )
    cases.append(
        measure("POD + GP (60), 20 nodes", reduced.at(observed), tests, reference, offline, 60)
    )
    return cases


def pareto(points: np.ndarray) -> np.ndarray:
    """Pareto front, (c,) bool: the rows (time, error) that no other row beats in both."""
    return np.array([not (points < row).all(axis=1).any() for row in points])


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Error against time of a value and of a gradient, the fronts joined."""
    plt = pyplot()
    figure, panels = plt.subplots(1, 2, figsize=(14, 5.2), sharey=True, layout="constrained")
    colours = {"FEM": "tab:green", "emu": "tab:blue", "POD": "tab:orange"}
    for axes, key, title in zip(
        panels, ("value_s", "gradient_s"), ("one value", "one value with its gradient"), strict=True
    ):
        points = np.array([[1e3 * case[key], case["err_u_mm"]["median"]] for case in cases])
        best = points[pareto(points)]
        best = best[np.argsort(best[:, 0])]
        axes.step(best[:, 0], best[:, 1], where="post", color="0.6", lw=1, label="Pareto front")
        for number, (case, (x, y)) in enumerate(zip(cases, points, strict=True), start=1):
            colour = colours[case["name"][:3]]
            name = f"{number}  {case['name']}, offline {case['offline_s']:.0f} s"
            axes.plot(x, y, "o", color=colour, ms=6, label=name)
            # Labels of neighbouring points are put on different sides.
            side = [(7, 5), (7, -12), (-12, -12), (-12, 5)][number % 4]
            axes.annotate(str(number), (x, y), xytext=side, textcoords="offset points")
        axes.set(xscale="log", yscale="log", xlabel=f"time of {title} (ms)")
        axes.grid(alpha=0.25)
    panels[0].set_ylabel("median displacement error (mm)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False, fontsize=9)
    figure.suptitle("once-clamped beam, 390 nodes, 2 parameters: what accuracy costs in time")
    save(figure, path)


def check(cases: list[dict[str, Any]]) -> None:
    """The claims of the study's README."""
    by_name = {case["name"]: case for case in cases}
    error = {name: case["err_u_mm"]["median"] for name, case in by_name.items()}
    assert error["FEM from rest"] < 1e-6
    assert error["emulator, full field"] < 1e-6
    assert error["emulator + 1 Newton step"] < error["emulator, full field"]
    assert error["emulator, full field"] < 0.1 * error["POD + GP, 60 FEM runs"]


def check_times(cases: list[dict[str, Any]]) -> None:
    """The claims about time, which need enough cases for a median."""
    gradient = {case["name"]: case["gradient_s"] for case in cases}
    fast = gradient["emulator, 20 observed nodes"]
    assert fast < 0.1 * gradient["FEM started by the emulator"]
    assert fast < gradient["emulator, full field"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=50, help="test theta")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    cases = study(arguments.cases)
    write_json(arguments.out / "results.json", {**study_header(HERE, SEED), "cases": cases})
    draw(cases, arguments.out / "pareto.png")
    check(cases)
    if arguments.cases >= 20:
        check_times(cases)


if __name__ == "__main__":
    main()
