"""Networks alone: how accurate are the shipped ones, and which idea gained how much?

    python -m studies.networks_alone
    python -m studies.networks_alone --quick --out DIR    # a coarse beam, few steps

The shipped ``<scene>_pignn`` are judged by FEM at theta that none has seen. Then the beam's is
trained again with one idea left out or exchanged at a time: equally many steps, FEM runs and test
theta, three seeds. Writes results.json, after each training, and networks.png beside itself or
under --out; trainings that results.json holds already are not repeated (--again). Asserts what the
README says.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
from studies.common.output import save, study_header

import emulator as em
from calibrate.figures import BLUE, pyplot
from emulator.accuracy.comparison import case_errors, quantiles
from emulator.core.store import write_json
from emulator.fem import Runs, run_campaign, sobol
from emulator.scenes import Scene
from emulator.surrogates import Architecture, Emulator, load, shipped
from emulator.training import recipe
from emulator.training.graph_network import GraphNetwork
from emulator.training.modal import ARCHITECTURE, Modal
from emulator.training.mode_fit import ModeFit
from emulator.training.network_plan import Problem, with_weights
from emulator.training.objectives import loss_scales
from emulator.training.optimiser import NetworkTraining, Steps
from emulator.training.plan import Job

HERE = Path(__file__).parent
TEST_SEED = 90_210
SCENES = ("once_clamped_beam", "twisting_cube", "liver", "left_ventricle")
ERRORS = ("err_u", "err_F", "err_Pi", "err_V")
SMALL = Architecture(
    steps=2, latent=8, hidden=(16, 16), decoder="separable", modes=6, trunk=(16, 40)
)


class ByAdam(ModeFit):
    """The modal recipe whose last layer descends like the others and is solved for at the end."""

    def descend(self, weights, number, *kept):
        """The misfit of the last layer as it is."""
        if kept:
            return super().descend(weights, number, *kept)
        value, gradient = jax.value_and_grad(self._misfit)(weights)
        # Of the logarithm, as in the recipe.
        return value, jax.tree.map(lambda g: (g / value).astype(g.dtype), gradient), weights

    def _misfit(self, weights):
        modes = self.network.prepare(weights)[1].astype(float)
        left = self.targets - np.moveaxis(~self.scene.held * modes, 0, -1)
        return self._square(left) / self._square(self.targets)

    def _square(self, fields):
        return (fields * self.weighted(fields)).sum()


@dataclass(frozen=True)
class Idea:
    """A way of training.

    plan : what differs from the plan of its recipe. modal : what differs in a modal training.
    """

    name: str
    recipe: str = "modal"
    plan: Callable[[Any], Any] = lambda plan: plan
    modal: Callable[[ModeFit], ModeFit] = lambda modal: modal
    optimiser: optax.GradientTransformation | None = None


def _adams(modal: ModeFit) -> ModeFit:
    return ByAdam(modal.scene, modal.network, modal.runs, modal.scales)


def _without_gradients(modal: ModeFit) -> ModeFit:
    return replace(modal, scales=modal.scales._replace(gradient=1e9))


def _on_lists(transformation: optax.GradientTransformation) -> optax.GradientTransformation:
    """The same for weights of any structure: Muon asks what kinds of leaves there are."""

    def update(gradient: Any, state: Any, weights: Any) -> tuple[Any, Any]:
        lists = [jax.tree.leaves(tree) for tree in (gradient, weights)]
        updates, state = transformation.update(lists[0], state, lists[1])
        return jax.tree.unflatten(jax.tree.structure(gradient), updates), state

    return optax.GradientTransformation(lambda w: transformation.init(jax.tree.leaves(w)), update)


IDEAS = (
    Idea("pointwise, displacements", "network", lambda p: replace(p, objective="simulations")),
    Idea("pointwise, with gradients", "network", lambda p: replace(p, objective="gradients")),
    Idea(
        "separable, with gradients",
        "network",
        lambda p: replace(p, objective="gradients", decoder="separable"),
    ),
    Idea("modal, last layer by Adam", modal=_adams),
    Idea("modal, no slopes", modal=lambda modal: replace(modal, slopes=0.0)),
    Idea("modal, no gradients", modal=_without_gradients),
    Idea("modal, no L-BFGS", plan=lambda p: replace(p, polish=0)),
    Idea("modal, processor frozen early", plan=lambda p: replace(p, freeze=p.steps // 10)),
    Idea("modal, Muon for Adam", optimiser=_on_lists(optax.contrib.muon(-1.0))),
    Idea("modal"),
)


def trained(idea: Idea, scene: Any, seed: int, arguments: argparse.Namespace) -> Emulator:
    """The emulator that ``idea`` leads to."""
    steps, runs = arguments.steps, arguments.simulations
    plan: Any = recipe(idea.recipe).with_counts(steps=steps, simulations=runs)
    plan = replace(plan, seed=seed)
    if isinstance(plan, Modal):
        plan = replace(plan, freeze=steps // 2, polish=arguments.polish)
    plan = idea.plan(plan)
    sizes = SMALL if arguments.quick else ARCHITECTURE
    if isinstance(plan, GraphNetwork) and plan.decoder == "pointwise":
        sizes = Architecture(2, 8, (16, 16)) if arguments.quick else Architecture()
    problem = plan.prepare(Job(scene, sizes))
    training = _with(idea, problem)
    state, advance = training.initial(), Steps(training)
    for _ in range(plan.steps):
        state = advance(state, plan.steps)
    return with_weights(problem.emulator, training.finish(state.weights, False))


def _with(idea: Idea, problem: Problem) -> NetworkTraining:
    if not isinstance(problem.plan, Modal):
        return problem.training
    scene, runs = problem.emulator.scene, problem.runs
    scales = loss_scales(scene, runs, from_runs=True)
    fit, plan = idea.modal(ModeFit(scene, problem.training.network, runs, scales)), problem.plan
    return replace(
        problem.training,
        optimiser=idea.optimiser or problem.training.optimiser,
        descend=fit.descend,
        frozen=fit.branch_targets,
        finish=partial(fit.finish, plan.polish),
    )


def errors_of(emulator: Emulator, known: Any) -> dict[str, Any]:
    """Quantiles of the errors against FEM."""
    found = case_errors(emulator.cache(), known.theta, known.displacement)
    return {key: quantiles(found.fields[key]) for key in ERRORS if key in found.fields}


def known_of(scene: Scene, tests: int) -> Runs:
    """FEM at theta that nothing was trained on."""
    return run_campaign(em.Simulator(scene), sobol(scene, tests, TEST_SEED))


def alone(name: str, tests: int) -> dict[str, Any]:
    """How accurate the shipped network of scene ``name`` is, and the emulator shipped beside it.

    Each on its own mesh: the network's is of linear elements.
    """
    network, beside = load(f"{name}_pignn"), load(name)
    record = network.record
    return {
        "name": name,
        "status": "done",
        "parts": list(network.parts),
        "command": record["command"],
        "seconds": record["seconds"],
        "fem_runs": record["plan"]["simulations"] + 1,
        "tests": tests,
        "network": errors_of(network, known_of(network.scene, tests)),
        "shipped": errors_of(beside, known_of(beside.scene, tests)),
    }


def study(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """All rows; those there already are kept."""
    path = arguments.out / "results.json"
    cases = [] if arguments.again or not path.is_file() else json.loads(path.read_text())["cases"]

    def add(row: dict[str, Any]) -> None:
        cases.append(row)
        write_json(path, {**study_header(HERE, TEST_SEED), "cases": cases})
        err = row.get("network", row.get("errors"))["err_u"]["median"]
        print(f"{row['name']:45s} err_u {err:.2e}  {row['seconds']:6.0f} s", flush=True)

    done = {case["name"] for case in cases}
    for name in SCENES[:1] if arguments.quick else SCENES:
        if name not in done and f"{name}_pignn" in shipped():
            add(alone(name, arguments.tests))
    scene = em.scenes.once_clamped_beam(*([(4, 2, 2)] if arguments.quick else []), order=1)
    known = known_of(scene, arguments.tests)
    for seed in range(arguments.seeds):
        for idea in IDEAS:
            name = f"{idea.name}, seed {seed}"
            if name in done:
                continue
            begin = time.process_time()
            emulator = trained(idea, scene, seed, arguments)
            facts = {"idea": idea.name, "seed": seed, "steps": arguments.steps}
            seconds = round(time.process_time() - begin, 1)
            add({"name": name, "status": "done", **facts, "seconds": seconds,
                 "errors": errors_of(emulator, known)})  # fmt: skip
    return cases


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Medians by idea, a dot a seed: displacements and deformation gradients."""
    plt = pyplot()
    rows = [case for case in cases if "idea" in case]
    names = [idea.name for idea in IDEAS]
    figure, both = plt.subplots(1, 2, figsize=(10.0, 4.2), layout="constrained", sharey=True)
    for axes, key, label in zip(both, ("err_u", "err_Pi"), ("err_u, mm", "err_Pi, %"), strict=True):
        for seed, mark in enumerate("os^"):
            mine = [row for row in rows if row["seed"] == seed]
            x = [row["errors"][key]["median"] for row in mine]
            y = [names.index(row["idea"]) for row in mine]
            axes.plot(x, y, mark, color=BLUE, mfc="none", label=f"seed {seed}")
        axes.set(xscale="log", xlabel=f"median {label}")
        axes.grid(axis="x", color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
    both[0].set_yticks(range(len(names)), names)
    both[0].invert_yaxis()
    both[1].legend(frameon=False)
    figure.suptitle("The beam's network alone: equally many steps and FEM runs")
    save(figure, path)


def medians(cases: list[dict[str, Any]], idea: str, key: str) -> list[float]:
    """Median errors of an idea, by seed."""
    return [case["errors"][key]["median"] for case in cases if case.get("idea") == idea]


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--polish", type=int, default=1000, help="iterations of L-BFGS")
    parser.add_argument("--simulations", type=int, default=100)
    parser.add_argument("--tests", type=int, default=50)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--again", action="store_true", help="repeat what is there")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    if arguments.quick:
        few = {"steps": 40, "polish": 50, "simulations": 20, "tests": 3, "seeds": 1}
        for name, value in few.items():
            setattr(arguments, name, value)
    arguments.out.mkdir(parents=True, exist_ok=True)
    cases = study(arguments)
    draw(cases, arguments.out / "networks.png")
    if arguments.quick:
        return
    found = {name: max(medians(cases, name, "err_u")) for name in (i.name for i in IDEAS)}
    assert found["modal"] < 0.1 * min(medians(cases, "pointwise, with gradients", "err_u"))


if __name__ == "__main__":
    main()
