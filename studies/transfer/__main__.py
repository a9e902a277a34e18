"""Transfer: a network trained on a family of ventricles, on a new one (App. E of the paper).

``python -m studies.transfer [--quick] [--one]``. Trains one network on a family of ventricles,
then trains on a ventricle of another shape and another mesh, from scratch and from the family, each
for several numbers of steps. Writes results.json and transfer.png beside itself, or under --out,
and asserts what the README says.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import save, study_header
from studies.transfer.pretraining import pretrain

import emulator as em
from calibrate.figures import pyplot
from emulator.accuracy.comparison import evaluate, field_errors, quantiles
from emulator.core.store import write_json
from emulator.fem import Runs, run_campaign, sobol
from emulator.geometry.facets import Cavity
from emulator.scenes import Scene
from emulator.scenes.scene import cavity_sets
from emulator.surrogates import Architecture, Emulator
from emulator.training import recipe, train
from emulator.training.graph_network import GraphNetwork, predictor
from emulator.training.network_plan import Problem, with_network_of
from emulator.training.plan import Job

HERE = Path(__file__).parent
TEST_SEED = 90_210
FAMILY_SEED = 11
# Ranges of the family in mm: short and long semi-axis inside, thickness at the equator and at the
# apex, height of the base. The new ventricle lies inside them and is no member.
LOW, HIGH = (18.0, 48.0, 8.0, 5.5, 14.0), (29.0, 66.0, 13.0, 9.0, 22.0)
UNSEEN = (26.0, 52.0, 35.5, 59.0, 17.0)
MESHES = {"family": (6, 12, 2), "unseen": (7, 14, 2)}  # rings, around, layers
QUICK_MESHES = {"family": (4, 8, 1), "unseen": (5, 10, 1)}
SIZES = Architecture(steps=3, latent=24, hidden=(64, 64))
QUICK_SIZES = Architecture(steps=2, latent=8, hidden=(16, 16))
STARTS = {"scratch": "from scratch", "one": "from one ventricle", "family": "from the family"}


def family(count: int, mesh: tuple[int, int, int]) -> list[Scene]:
    """``count`` ventricles drawn from the ranges above, the built-in one not among them."""
    draws = np.random.default_rng(FAMILY_SEED).uniform(LOW, HIGH, (count, len(LOW)))
    walls = [
        (short, long, short + equator, long + apex, base)
        for short, long, equator, apex, base in draws.tolist()
    ]
    return [em.scenes.left_ventricle(*mesh, wall=wall, order=1) for wall in walls]


def judge(problem: Problem, known: Runs) -> Callable[[Any], dict[str, Any]]:
    """Function of weights: err_u in mm and err_V in percent at the ``known`` FEM solutions."""
    scene = problem.emulator.scene
    cavities = [Cavity(scene.mesh, name) for name in cavity_sets(scene)]
    predict = predictor(problem.emulator)

    @jax.jit
    def errors(weights: Any) -> dict[str, jax.Array]:
        u = predict(weights, known.theta)
        one = lambda t, v, exact: field_errors(scene, t, v, exact, cavities)  # noqa: E731
        return jax.vmap(one)(known.theta, u, known.displacement)

    def report(weights: Any) -> dict[str, Any]:
        found = errors(weights)
        return {name: quantiles(found[name]) for name in ("err_u", "err_V")}

    return report


def steps_from(problem: Problem, start: Emulator, total: int) -> tuple[Any, float]:
    """Weights after a whole training of ``total`` steps, and the seconds of one step."""
    weights = with_network_of(problem.emulator, start).network.weights
    training = problem.training
    state = training.optimiser.init(weights)
    began = time.perf_counter()
    for number in range(total):
        weights, state, _ = training.step(weights, state, jnp.asarray(number), jnp.asarray(total))
    jax.block_until_ready(weights)
    return weights, (time.perf_counter() - began) / max(total, 1)


def mechanics(scene: Scene, runs: int, known: Runs) -> dict[str, Any]:
    """The recipe without a network on the same ventricle, for comparison."""
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        forward = train(scene, replace(recipe("mechanics"), simulations=runs), folder).cache()
        jax.block_until_ready(forward(scene.centre))
    seconds = round(time.perf_counter() - began, 1)
    report = evaluate(forward, known.theta, known.displacement)
    found = {key: report[key] for key in ("err_u", "err_V")}
    return {
        "name": "mechanics",
        "status": "done",
        "fem_runs": runs + 1,
        "seconds": seconds,
        **found,
    }


def curves(
    problem: Problem,
    starts: dict[str, Emulator],
    budgets: list[int],
    longest: int,
    report: Callable[[Any], dict[str, Any]],
) -> list[dict[str, Any]]:
    """One case for each start and number of steps; the longest from scratch only."""
    plan = [(start, steps) for steps in (0, *budgets) for start in starts] + [("scratch", longest)]
    cases = []
    for start, steps in plan:
        weights, a_step = steps_from(problem, starts[start], steps)
        case = {
            "name": f"{STARTS[start]}, {steps} steps",
            "status": "done",
            "start": start,
            "steps": steps,
            "seconds": round(a_step * steps, 2),
            **report(weights),
        }
        cases.append(case)
        print(
            f"{case['name']:32s} {case['seconds']:7.1f} s  err_u median "
            f"{case['err_u']['median']:.3e} mm  err_V {case['err_V']['median']:.2e} %",
            flush=True,
        )
    return cases


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Median errors against the number of steps, one line for each start."""
    plt = pyplot()
    figure, panels = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    by_hand = next(case for case in cases if case["name"] == "mechanics")
    colours = {"scratch": "tab:blue", "one": "tab:orange", "family": "tab:green"}
    for axes, key, unit in ((panels[0], "err_u", "mm"), (panels[1], "err_V", "%")):
        for start, label in STARTS.items():
            line = [case for case in cases if case.get("start") == start]
            if not line:
                continue
            x = [case["steps"] for case in line]
            axes.plot(
                x, [case[key]["median"] for case in line], "o-", color=colours[start], label=label
            )
        value = by_hand[key]["median"]
        label = f"recipe mechanics, {by_hand['fem_runs']} FEM runs, no network"
        axes.axhline(value, color="0.3", ls="--", label=label)
        counts = [case["steps"] for case in cases if case.get("steps")]
        axes.set_xscale("symlog", linthresh=min(counts))
        axes.set_xlim(-0.1 * min(counts), 1.3 * max(counts))
        axes.set(yscale="log", xlabel="training steps on the new ventricle (0: none yet)")
        axes.set_ylabel(f"{key}, median over the held-out FEM runs ({unit})")
        axes.grid(alpha=0.25)
    panels[0].legend(frameon=False, fontsize=8)
    save(figure, path)


def summarise(cases: list[dict[str, Any]]) -> dict[str, Any]:
    """Errors from scratch over those of each transfer, at equal numbers of steps."""
    error = {(c["start"], c["steps"]): c["err_u"]["median"] for c in cases if "start" in c}
    counts = sorted({steps for start, steps in error if start == "family"})
    return {
        f"err_u from scratch / {STARTS[start]}": {
            str(n): round(error["scratch", n] / error[start, n], 2) for n in counts
        }
        for start in ("one", "family")
        if (start, 0) in error
    }


def check(cases: list[dict[str, Any]]) -> None:
    """The claims of the study's README that do not depend on the machine."""
    errors = {(c.get("start"), c.get("steps")): c["err_u"]["median"] for c in cases}
    assert errors["family", 0] < 0.6 * errors["scratch", 0]
    for start, steps in errors:
        if start == "family":
            assert errors[start, steps] < errors["scratch", steps], steps
        if start is not None:
            assert errors[None, None] < 0.1 * errors[start, steps], (start, steps)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="toy sizes, no claims checked")
    parser.add_argument("--family", type=int, default=4, help="ventricles of the family")
    parser.add_argument("--one", action="store_true", help="start from a single ventricle as well")
    parser.add_argument("--pretrain", type=int, default=1600, help="steps")
    parser.add_argument("--steps", type=int, nargs="+", default=[200, 400, 800])
    parser.add_argument("--longest", type=int, default=3200, help="from scratch, the reference")
    parser.add_argument("--runs", type=int, default=20, help="FEM runs of the recipe mechanics")
    parser.add_argument("--tests", type=int, default=30)
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    meshes, sizes = (QUICK_MESHES, QUICK_SIZES) if arguments.quick else (MESHES, SIZES)
    began = time.perf_counter()
    plan = GraphNetwork(objective="energy", steps=arguments.pretrain, batch=8, learning_rate=2e-3)
    groups = {"family": family(arguments.family, meshes["family"])}
    if arguments.one:
        groups["one"] = [em.scenes.left_ventricle(*meshes["family"], order=1)]
    starts: dict[str, Emulator] = {}
    pretraining: dict[str, Any] = {}
    for name, scenes in groups.items():
        with tempfile.TemporaryDirectory() as folder:
            starts[name] = pretrain(scenes, plan, folder, architecture=sizes)[0]
        record = starts[name].record
        pretraining[name] = {"ventricles": len(scenes), "steps": plan.steps, **record}
        print(f"pretrained on {len(scenes)} ventricles: {record['seconds']} s", flush=True)

    scene = em.scenes.left_ventricle(*meshes["unseen"], wall=UNSEEN, order=1)
    known = run_campaign(em.Simulator(scene), sobol(scene, arguments.tests, TEST_SEED))
    cases = [mechanics(scene, arguments.runs, known)]
    print(f"mechanics: {cases[0]['seconds']} s, {cases[0]['err_u']['median']:.2e} mm", flush=True)
    ready = time.perf_counter()
    problem = plan.prepare(Job(scene, sizes))
    steps_from(problem, problem.emulator, 1)
    ready = time.perf_counter() - ready
    network = problem.emulator.network
    starts = {"scratch": problem.emulator, **starts}
    report = judge(problem, known)
    cases += curves(problem, starts, arguments.steps, arguments.longest, report)
    longest = cases[-1]
    summary = {
        "nodes": {"family": len(groups["family"][0].mesh.nodes), "unseen": len(scene.mesh.nodes)},
        "architecture": asdict(sizes),
        "weights": int(sum(leaf.size for leaf in jax.tree.leaves(network.weights))),
        "ms_a_step": round(1e3 * longest["seconds"] / longest["steps"], 2),
        "prepare_and_compile_s": round(ready, 1),
        "pretraining": pretraining,
        **summarise(cases),
        "seconds": round(time.perf_counter() - began, 1),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    header = study_header(HERE, TEST_SEED)
    write_json(arguments.out / "results.json", {**header, "summary": summary, "cases": cases})
    draw(cases, arguments.out / "transfer.png")
    if not arguments.quick:
        check(cases)


if __name__ == "__main__":
    main()
