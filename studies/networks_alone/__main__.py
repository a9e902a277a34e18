"""Networks alone: how accurate are the shipped ones, and which idea gained how much?

    python -m studies.networks_alone
    python -m studies.networks_alone --quick --out DIR    # a coarse beam, few steps

The shipped networks, which sweeps have taught, are judged by FEM at theta that none has
seen. Then the beam's is trained again, on FEM runs, with one idea left out or exchanged at a time:
equally many steps, runs and test theta, three seeds. Writes results.json, after each training, and
networks.png beside itself or under --out; trainings that results.json holds already are not
repeated (--again). Asserts what the README says.
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
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from studies.common.output import save, study_header

import emulator as em
from calibrate.figures import BLUE, pyplot
from emulator.accuracy.comparison import case_errors, quantiles
from emulator.core.store import write_json
from emulator.fem import Runs, run_campaign, sobol
from emulator.scenes import Scene
from emulator.surrogates import Architecture, Emulator, load, shipped
from emulator.training.job import Job
from emulator.training.mode_fit import ModeFit, scales_of
from emulator.training.optimiser import (
    NetworkTraining,
    PreparedTraining,
    clipped_adam,
    with_weights,
)
from emulator.training.physics import ARCHITECTURE, PhysicsPlan, prepare

HERE = Path(__file__).parent
TEST_SEED = 90_210
SCENES = ("once_clamped_beam", "twisting_cube", "liver", "left_ventricle")
ERRORS = ("err_u", "err_F", "err_Pi", "err_V")
SMALL = Architecture(
    steps=2, latent=8, hidden=(16, 16), decoder="separable", modes=6, trunk=(16, 40)
)


class ByAdam(ModeFit):
    """A fit of modes whose last layer descends like the others and is solved for at the end."""

    def descend(self, weights, number):
        """The misfit of the last layer as it is."""
        del number
        value, gradient = jax.value_and_grad(self._misfit)(weights)
        # Of the logarithm, as in the recipe.
        return value, jax.tree.map(lambda g: (g / value).astype(g.dtype), gradient), weights

    def _misfit(self, weights):
        modes = self.network.prepare(weights)[1].astype(float)
        left = self.targets - np.moveaxis(~self.scene.held * modes, 0, -1)
        return self._square(left) / self._square(self.targets)

    def _square(self, fields):
        return (fields * self.weighted(fields)).sum()


class WholeBranch(ModeFit):
    """A fit whose branch descends with its last layer, which is not solved for."""

    def _fit_branch(self, weights, targets):
        """The layer as it is; gradients pass."""
        branch = nnx.merge(self.network.definition, weights).decoder.branch
        features, wanted = self._branch_rows(branch, targets)
        last = branch.layers[-1]
        B = jnp.concatenate([last.kernel.get_value(), last.bias.get_value()[None]]).astype(float)
        return B, targets.misfit(features @ B, wanted)


@dataclass(frozen=True)
class Idea:
    """A way of training.

    plan : what differs from the plan of its recipe. fit : what differs in the fit of modes.
    """

    name: str
    plan: Callable[[Any], Any] = lambda plan: plan
    fit: Callable[[ModeFit], ModeFit] = lambda fit: fit
    optimiser: optax.GradientTransformation | None = None


def _adams(fit: ModeFit) -> ModeFit:
    return ByAdam(fit.scene, fit.network, fit.runs, fit.scales)


def _whole_branch(fit: ModeFit) -> ModeFit:
    return WholeBranch(fit.scene, fit.network, fit.runs, fit.scales)


def _without_gradients(fit: ModeFit) -> ModeFit:
    return replace(fit, scales=fit.scales._replace(gradient=1e9))


IDEAS = (
    Idea("modes"),
    Idea("modes, the whole branch by L-BFGS", fit=_whole_branch),
    Idea("modes, last layer by Adam", fit=_adams),
    Idea("modes, Adam for Muon", optimiser=clipped_adam()),
    Idea("modes, a tenth of the steps", plan=lambda p: replace(p, steps=p.steps // 10)),
    Idea("modes, no L-BFGS", plan=lambda p: replace(p, polish=0)),
    Idea("modes, no slopes", fit=lambda fit: replace(fit, slopes=0.0)),
    Idea("modes, no gradients", fit=_without_gradients),
)


def trained(idea: Idea, scene: Any, seed: int, arguments: argparse.Namespace) -> Emulator:
    """The emulator that ``idea`` leads to."""
    steps, runs = arguments.steps, arguments.simulations
    plan = PhysicsPlan(sweeps=0, steps=steps, simulations=runs, seed=seed)
    plan = idea.plan(replace(plan, polish=arguments.polish))
    problem = prepare(plan, Job(scene, SMALL if arguments.quick else ARCHITECTURE))
    training = _with(idea, problem, plan.polish)
    state = training.initial(plan.steps)
    for _ in range(plan.steps):
        state = training.advance(state)
    return with_weights(problem.emulator, training.finish(state.weights, False))


def _with(idea: Idea, problem: PreparedTraining, polish: int) -> NetworkTraining:
    scene, runs = problem.emulator.scene, problem.runs
    scales = scales_of(scene, runs)
    fit = idea.fit(ModeFit(scene, problem.training.network, runs, scales))
    return replace(
        problem.training,
        optimiser=idea.optimiser or problem.training.optimiser,
        descend=fit.descend,
        finish=partial(fit.finish, polish, np.inf),
    )


def errors_of(emulator: Emulator, known: Any) -> dict[str, Any]:
    """Quantiles of the errors against FEM."""
    found = case_errors(emulator.cache(), known.theta, known.displacement)
    return {key: quantiles(found.fields[key]) for key in ERRORS if key in found.fields}


def known_of(scene: Scene, tests: int) -> Runs:
    """FEM at theta that nothing was trained on."""
    return run_campaign(em.Simulator(scene), sobol(scene, tests, TEST_SEED))


def alone(name: str, tests: int) -> dict[str, Any]:
    """How accurate the shipped network of scene ``name`` is, and the emulator shipped beside it."""
    network, beside = load(name), load(name, kind="series")
    record = network.record
    return {
        "name": name,
        "status": "done",
        "parts": list(network.parts),
        "command": record["command"],
        "seconds": record["seconds"],
        "sweeps": record["sweeps"]["number"],
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
        if name not in done and name in shipped():
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
    there = {row["idea"] for row in rows}
    names = [idea.name for idea in IDEAS if idea.name in there]
    figure, both = plt.subplots(1, 2, figsize=(10.0, 4.2), layout="constrained", sharey=True)
    for axes, key, label in zip(both, ("err_u", "err_Pi"), ("err_u, mm", "err_Pi, %"), strict=True):
        for seed, mark in enumerate("os^"):
            if not (mine := [row for row in rows if row["seed"] == seed]):
                continue
            x = [row["errors"][key]["median"] for row in mine]
            y = [names.index(row["idea"]) for row in mine]
            axes.plot(x, y, mark, color=BLUE, mfc="none", label=f"seed {seed}")
        axes.set(xscale="log", xlabel=f"median {label}")
        axes.tick_params(which="minor", labelbottom=False)
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
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--polish", type=int, default=300, help="iterations of L-BFGS")
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
    worst = max(medians(cases, "modes", "err_u"))
    assert worst < min(medians(cases, "modes, last layer by Adam", "err_u"))


if __name__ == "__main__":
    main()
