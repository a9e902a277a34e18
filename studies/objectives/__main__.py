"""Errors of a network after equally many steps of each training objective, against FEM.

    python -m studies.objectives [--steps N] [--simulations N] [--tests N]
    python -m studies.objectives --quick --out DIR    # a coarse beam, few steps

Each objective is trained in a process of its own, so that compilation and FEM runs count and no
kept factor of another's runs is used. Processor time depends less than wall-clock time on other
load of the machine; both are kept. Writes results.json and objectives.png beside itself, or under
--out, and asserts what the README says.
"""

import argparse
import subprocess
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from studies.common.output import save, study_header
from studies.common.processes import command, environment

import emulator as em
from calibrate.figures import pyplot
from calibrate.figures.evaluation import LABELS
from emulator.accuracy.comparison import Errors, case_errors, log_density, quantiles
from emulator.core.store import write_json
from emulator.fem import run_campaign, sobol
from emulator.scenes import Scene
from emulator.surrogates import Architecture, load, save_emulator
from emulator.training import recipe, remove_checkpoint, train
from emulator.training.graph_network import GraphNetwork

HERE = Path(__file__).parent
TEST_SEED = 90_210
# By our name: the paper's name and a colour.
OBJECTIVES = {
    "simulations": ("DD", "tab:orange"),
    "gradients": ("F-DD", "tab:green"),
    "energy": ("PI", "tab:blue"),
    "both": ("DD and PI", "tab:red"),
}
UNTRAINED, MECHANICS = "the centre's solution", "recipe mechanics"
ERRORS = ("err_u", "err_F", "err_I1", "err_Pi")  # those of the paper, drawn and judged
COARSE = (4, 2, 2)
SMALL = Architecture(steps=2, latent=8, hidden=(16, 16))


def beam(quick: bool) -> Scene:
    """The built-in beam of linear elements, or a coarse one."""
    return em.scenes.once_clamped_beam(*([COARSE] if quick else []), order=1)


def plan_of(objective: str, steps: int, simulations: int, quick: bool) -> GraphNetwork:
    """The recipe ``network`` with ``objective``; initial weights, theta and rates do not differ."""
    plan = replace(recipe("network"), steps=steps, simulations=simulations)
    plan = replace(plan, objective=objective)  # a name of OBJECTIVES
    return replace(plan, batch=8, learning_rate=3e-3) if quick else plan


def train_one(scene: Scene, plan: GraphNetwork, folder: Path, quick: bool) -> None:
    """Train and write the emulator to ``folder``, with this process's processor time."""
    trained = train(scene, plan, folder, architecture=SMALL if quick else None)
    record = {**trained.record, "processor_s": round(time.process_time(), 1)}
    save_emulator(replace(trained, record=record), folder)
    remove_checkpoint(folder)


def in_its_own_process(objective: str, folder: Path, arguments: argparse.Namespace) -> None:
    """:func:`train_one` in a process that has compiled and factorised nothing before."""
    words = ["--one", objective, "--out", str(folder), "--steps", str(arguments.steps)]
    words += ["--simulations", str(arguments.simulations)]
    words += ["--quick"] if arguments.quick else []
    subprocess.run(command("objectives", *words), check=True, env=environment())


def fem_seconds(scene: Scene, plan: GraphNetwork) -> float:
    """Processor time of the FEM runs that ``plan`` trains on, compilation included."""
    thetas = scene.centre[None]
    if plan.runs:
        thetas = jnp.concatenate([thetas, sobol(scene, plan.runs, plan.seed)])
    begin = time.process_time()
    run_campaign(em.Simulator(scene), thetas)
    return round(time.process_time() - begin, 1)


def row(name: str, errors: Errors, **facts: object) -> dict[str, Any]:
    """A row of the table: quantiles of the four errors, and seconds."""
    found = {key: quantiles(errors.fields[key]) for key in LABELS if key in errors.fields}
    told = "  ".join(f"{key} {value['median']:.2e}" for key, value in found.items())
    print(f"{name:22s} {told}", flush=True)
    return {"name": name, "status": "done", **facts, **found}


def study(arguments: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, Errors]]:
    """Train by every objective and compare with FEM at theta that none was trained on."""
    scene = beam(arguments.quick)
    plans = {
        objective: plan_of(objective, arguments.steps, arguments.simulations, arguments.quick)
        for objective in OBJECTIVES
    }
    fem = {objective: fem_seconds(scene, plans[objective]) for objective in ("energy", "both")}
    known = run_campaign(em.Simulator(scene), sobol(scene, arguments.tests, TEST_SEED))
    cases, errors = [], {}
    with tempfile.TemporaryDirectory() as temporary:
        for objective, plan in plans.items():
            folder = (arguments.emulators or Path(temporary)) / objective
            if not (folder / "emulator.json").is_file():
                in_its_own_process(objective, folder, arguments)
            trained = load(folder, scene)
            if trained.record["plan"] != asdict(plan):
                raise SystemExit(f"{folder} was trained otherwise: {trained.record['plan']}")
            errors[objective] = case_errors(trained.cache(), known.theta, known.displacement)
            facts = {
                "paper": OBJECTIVES[objective][0],
                "steps": plan.steps,
                "fem_runs": plan.runs + 1,
                "seconds": trained.record["seconds"],
                "processor_s": trained.record["processor_s"],
                "fem_processor_s": fem["both" if plan.runs else "energy"],
            }
            cases.append(row(objective, errors[objective], **facts))
    before = replace(trained, network=None)  # a series of order 0: the centre's solution
    errors[UNTRAINED] = case_errors(before.cache(), known.theta, known.displacement)
    cases.append(row(UNTRAINED, errors[UNTRAINED], fem_runs=1))
    if not arguments.quick:
        with tempfile.TemporaryDirectory() as folder:
            by_mechanics = train(scene, replace(recipe("mechanics"), simulations=200), folder)
        ours = case_errors(by_mechanics.cache(), known.theta, known.displacement)
        facts = {"fem_runs": 201, "seconds": by_mechanics.record["seconds"]}
        cases.append(row(MECHANICS, ours, **facts))
    return cases, errors


def draw(errors: dict[str, Errors], path: Path, title: str) -> None:
    """Densities of the four errors, one curve for each objective."""
    plt = pyplot()
    figure, grid = plt.subplots(2, 2, figsize=(9.5, 6.6), layout="constrained")
    for axes, name in zip(grid.flat, ERRORS, strict=True):
        for label, found in errors.items():
            curve = log_density(found.fields[name])
            if curve is None:
                continue
            if label == UNTRAINED:
                axes.plot(*curve, color="0.55", lw=1.2, ls="--", label=label)
                continue
            paper, colour = OBJECTIVES[label]
            axes.plot(*curve, color=colour, lw=1.7, label=f"{label} ({paper})")
            axes.axvline(quantiles(found.fields[name])["median"], color=colour, lw=0.8, ls=":")
        axes.set(xscale="log", xlabel=LABELS[name], ylim=(0.0, None), yticks=[])
        axes.spines[["top", "right", "left"]].set_visible(False)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    figure.suptitle(title)
    save(figure, path)


def check(cases: list[dict[str, Any]]) -> None:
    """The claims of the study's README."""
    medians = {key: {case["name"]: case[key]["median"] for case in cases} for key in ERRORS}
    for key in ("err_F", "err_I1", "err_Pi"):
        assert medians[key]["gradients"] < 0.5 * medians[key]["simulations"], key
    assert medians["err_u"]["gradients"] < 2.0 * medians["err_u"]["simulations"]
    assert min(OBJECTIVES, key=medians["err_Pi"].__getitem__) == "both"
    assert medians["err_u"]["energy"] > 5.0 * medians["err_u"]["simulations"]
    for key, errors in medians.items():
        assert errors[MECHANICS] < 1e-3 * min(errors[name] for name in OBJECTIVES), key


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, help="optimiser steps (default 1000; 60 with --quick)")
    parser.add_argument("--simulations", type=int, help="FEM runs (default 128; 16 with --quick)")
    parser.add_argument("--tests", type=int, help="held-out theta (default 50; 4 with --quick)")
    parser.add_argument("--quick", action="store_true", help="a coarse beam and a small network")
    parser.add_argument("--emulators", type=Path, help="keep the trained here, use those there")
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--one", choices=tuple(OBJECTIVES), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    for name, full, quick in (("steps", 1000, 60), ("simulations", 128, 16), ("tests", 50, 4)):
        if getattr(arguments, name) is None:
            setattr(arguments, name, quick if arguments.quick else full)
    if arguments.one:
        plan = plan_of(arguments.one, arguments.steps, arguments.simulations, arguments.quick)
        train_one(beam(arguments.quick), plan, arguments.out, arguments.quick)
        return
    cases, errors = study(arguments)
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_json(arguments.out / "results.json", {**study_header(HERE, TEST_SEED), "cases": cases})
    title = f"once-clamped beam: {arguments.steps} steps by each objective, against FEM"
    draw(errors, arguments.out / "objectives.png", title)
    if not arguments.quick:
        check(cases)


if __name__ == "__main__":
    main()
