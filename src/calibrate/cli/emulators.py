"""``calibrate train`` and ``calibrate evaluate``."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibrate.cli.common import (
    DONE,
    add_json,
    add_scene,
    emit,
    seconds,
    show_progress,
    table,
)


def register(commands: Any) -> None:
    """Add the commands."""
    parser = commands.add_parser("train", help="train an emulator")
    add_scene(parser)
    parser.add_argument("--objective", choices=("energy", "simulations", "both"))
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--budget", metavar="TIME", help="time for everything, e.g. 10m (default 10m)"
    )
    length.add_argument("--steps", type=int, help="optimiser steps instead of a time")
    parser.add_argument("--simulations", type=int, help="FEM runs to train on")
    parser.add_argument("--batch", type=int, help="theta a step")
    parser.add_argument("--seed", type=int)
    parser.add_argument(
        "--resume", action="store_true", help="continue from the checkpoint in --out"
    )
    parser.add_argument("--out", required=True, metavar="DIR")
    add_json(parser)
    parser.set_defaults(run=train)
    parser = commands.add_parser("evaluate", help="errors of an emulator against FEM")
    parser.add_argument("emulator", metavar="EMULATOR", help="shipped name or folder")
    parser.add_argument(
        "--against", required=True, metavar="DIR|fem", help="a published model's folder, or our FEM"
    )
    parser.add_argument("--cases", type=int, default=50, help="FEM runs when against fem")
    add_json(parser)
    parser.set_defaults(run=evaluate)


def train(arguments: argparse.Namespace) -> int:
    """Train and write an emulator."""
    from calibrate.provenance import hardware, versions
    from emulator.errors import InputError
    from emulator.network import save_emulator
    from emulator.scenes import find_scene
    from emulator.store import check_folder
    from emulator.training import Plan, remove_checkpoint
    from emulator.training import train as train_emulator

    scene = find_scene(arguments.scene, arguments.root)
    check_folder(arguments.out)
    names = ("objective", "steps", "simulations", "batch", "seed")
    given = {name: getattr(arguments, name) for name in names}
    given = {name: value for name, value in given.items() if value is not None}
    if arguments.resume and (given or arguments.budget):
        option = next(iter(given), "budget")
        raise InputError(f"--{option} has no effect with --resume: the checkpoint has its plan")
    fixed = arguments.resume or "steps" in given
    result = train_emulator(
        scene,
        Plan(**given),
        arguments.out,
        budget=None if fixed else seconds(arguments.budget or "10m"),
        resume=arguments.resume,
        progress=show_progress(arguments),
    )
    record = {
        **result.record,
        "command": command_line(arguments.scene, result.record["plan"]),
        "budget": arguments.budget,
        "hardware": hardware(),
        "versions": versions(),
    }
    result = replace(result, record=record)
    save_emulator(result, arguments.out)
    remove_checkpoint(arguments.out)
    steps = record["plan"]["steps"]
    text = f"trained {scene.name}: {steps} steps, {record['seconds']:.0f} s, in {arguments.out}"
    emit({"out": arguments.out, **record}, as_json=arguments.json, text=text)
    return DONE


def command_line(scene: str, plan: dict[str, Any]) -> str:
    """The command that repeats a training exactly, whatever interrupted or hurried it."""
    names = ("objective", "steps", "simulations", "batch", "seed")
    options = " ".join(f"--{name} {plan[name]}" for name in names)
    return f"calibrate train {scene} {options} --out DIR"


def evaluate(arguments: argparse.Namespace) -> int:
    """Compare an emulator with stored or fresh FEM solutions."""
    from emulator.evaluation import evaluate as errors_of
    from emulator.network import load

    emulator = load(arguments.emulator)
    if arguments.against == "fem":
        from emulator.fem import Simulator
        from emulator.training import run_campaign, sobol

        # A seed of its own: the test points are not training points.
        thetas = sobol(emulator.scene, arguments.cases, seed=90_210)
        runs = run_campaign(Simulator(emulator.scene), thetas, progress=show_progress(arguments))
        reference = runs.displacement
    else:
        thetas, reference = _published(emulator, Path(arguments.against))
    report = errors_of(emulator.cache(), thetas, reference)
    report["emulator"] = arguments.emulator
    report["training"] = dict(emulator.record)
    names = [name for name in report["units"] if name in report]
    text = table(
        (f"{report['cases']} cases", "median", "mean", "97.5 %", "max", "unit"),
        [
            (
                name,
                *(report[name][q] for q in ("median", "mean", "q97_5", "max")),
                report["units"][name],
            )
            for name in names
        ],
    )
    emit(report, as_json=arguments.json, text=text)
    return DONE


def _published(emulator: Any, folder: Path) -> Any:
    """Theta and displacements of a released model whose mesh is the emulator's."""
    import jax.numpy as jnp
    import numpy as np

    from emulator.errors import InputError
    from emulator.scenes.published import published_scene, published_tests

    model, root = folder.resolve().name, folder.resolve().parent
    scene, ours = published_scene(model, root), emulator.scene
    same = (
        scene.mesh.nodes.shape == ours.mesh.nodes.shape
        and np.allclose(scene.mesh.nodes, ours.mesh.nodes, atol=1e-6 * ours.mesh.size)
        and np.array_equal(_as_set(scene.mesh.elements), _as_set(ours.mesh.elements))
        and np.array_equal(scene.held, ours.held)
        and np.allclose(scene.held_displacement, ours.held_displacement)
        and scene.law.name == ours.law.name
        and scene.loads == ours.loads
    )
    if not same:
        raise InputError(
            f"published model '{model}' is not the scene '{ours.name}' of the emulator "
            "(mesh, supports, law and loads must agree)"
        )
    thetas, tests = published_tests(model, root)
    if tests.displacement is None:
        raise InputError(
            f"published model '{model}' comes without displacements; use --against fem"
        )
    order = [scene.parameter_names.index(name) for name in ours.parameter_names]
    return thetas[:, jnp.array(order)], jnp.asarray(tests.displacement)


def _as_set(elements: Any) -> Any:
    import numpy as np

    return np.unique(np.sort(elements, axis=1), axis=0)
