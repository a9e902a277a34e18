"""``calibrate train`` and ``released``: commands that make an emulator."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from calibrate.cli.words import Answer, add_scene, command, flag, option, problem_of, seconds
from emulator.core.errors import InputError
from emulator.core.store import check_folder

if TYPE_CHECKING:
    from emulator.specimens.specimen import Specimen
    from emulator.training.plan import Plan


_ENTRIES = ("steps", "simulations", "sweeps", "batch", "seed")  # of a plan


def _add_plan(parser: ArgumentParser) -> None:
    from emulator.training import RECIPES

    parser.add_argument(
        "--recipe",
        choices=tuple(RECIPES),
        help="default mechanics: Taylor series and discrepancy model of FEM runs, in a minute; "
        "physics: a network alone without any FEM run, from the energy; sweeps: a polynomial, "
        "from the energy alone",
    )
    parser.add_argument(
        "--start",
        metavar="EMULATOR",
        help="begin from the network of a family of bodies (ventricle_family, or a folder) by "
        "sweeps, or by another recipe; for finer:SCENE by sweeps or two_meshes: stand on this "
        "emulator of SCENE; give it again with --resume",
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--budget",
        metavar="TIME",
        help="time for everything, e.g. 10m (default 10m; without a network, all FEM runs); with "
        "--resume the time from now on",
    )
    length.add_argument("--steps", type=int, help="optimiser steps instead of a time")


@command(
    add_scene,
    _add_plan,
    option("--simulations", type=int, help="FEM runs to train on"),
    option(
        "--sweeps", type=int, help="of recipes physics (0 for FEM runs in their place) and sweeps"
    ),
    option(
        "--campaign",
        "STORE.zarr",
        "take the FEM runs from this store of calibrate campaign, all that converged or the "
        "first --simulations of them; give it again with --resume",
    ),
    option("--batch", type=int, help="theta a step"),
    option("--seed", type=int),
    flag("--resume", "continue from the checkpoint in --out"),
    option("--out", "DIR", required=True),
    help="train an emulator",
)
def train(arguments: Namespace) -> Answer:
    """Train and write an emulator."""
    from calibrate.provenance import hardware, versions
    from emulator.scenes.scene import Scene, with_mesh
    from emulator.surrogates import load, save_emulator
    from emulator.training import remove_checkpoint
    from emulator.training import train as train_emulator

    problem = problem_of(arguments)
    if not isinstance(problem, Scene):
        from emulator.specimens.specimen import require_specimen

        if (specimen := require_specimen(problem)).grips is not None:
            return _train_grips(specimen, arguments)
    scene = with_mesh(problem)
    check_folder(arguments.out)
    entries = _plan_entries(arguments)
    start = load(arguments.start) if arguments.start else None
    usual = "mechanics" if start is None else "sweeps"
    plan = _plan(arguments.recipe or usual, entries, arguments.budget)
    campaign = None
    if arguments.campaign:
        from emulator.fem.campaign.store import read_runs

        campaign = read_runs(arguments.campaign, scene)
        if "simulations" not in entries and plan.runs:
            all_runs: dict[str, Any] = {"simulations": len(campaign.runs.theta)}
            plan = replace(plan, **all_runs)
    # A plan without a network has nothing but FEM runs: all are solved unless --budget limits them.
    unlimited = arguments.resume or "steps" in entries or not plan.trains_network
    budget = None if unlimited else "10m"
    if arguments.budget is not None:
        budget = arguments.budget
    result = train_emulator(
        scene,
        plan,
        arguments.out,
        start=start,
        campaign=campaign,
        budget=None if budget is None else seconds(budget),
        resume=arguments.resume,
        progress=not arguments.json,
    )
    record = {
        **result.record,
        "command": _command_line(arguments.scene, result.record),
        "budget": arguments.budget,
        "hardware": hardware(),
        "versions": versions(),
    }
    result = replace(result, record=record)
    save_emulator(result, arguments.out)
    remove_checkpoint(arguments.out)
    runs = record["plan"].get("simulations", 0)
    text = _training_summary(arguments.out, scene.name, record)
    if budget is not None and not arguments.resume and plan.runs > runs:
        text += f"\n{runs} of {plan.runs} FEM runs fit into the budget: more time, smaller errors"
    text += f"\nwritten to {arguments.out}; next: calibrate infer {arguments.scene} "
    text += f"--emulator {arguments.out} --data measured.csv --out RUN"
    return Answer({"out": arguments.out, **record}, text)


def _train_grips(scene: Specimen, arguments: Namespace) -> Answer:
    """Train and write the model of the stresses that the grips of a specimen add."""
    from emulator.specimens.gripped import RUNS, learn_grips

    out = Path(arguments.out)
    if out.suffix != ".safetensors":
        raise InputError(f"--out {out}: a specimen's grips are one file, NAME.safetensors")
    began = perf_counter()
    learned = learn_grips(
        scene,
        arguments.simulations or RUNS,
        seed=arguments.seed or 0,
        progress=not arguments.json,
    )
    learned.write(out)
    degree, time = int(learned.degrees.sum(axis=1).max()), perf_counter() - began
    text = (
        f"learned what the grips of {scene.name} add: polynomials of degree {degree}, "
        f"{100 * learned.error:.2g} % of a stress from FEM at held-out runs, {time:.0f} s\n"
        f'written to {out}; next: learned = "{out.name}" under [grips] of the scene file'
    )
    content = {"out": str(out), "degree": degree, "error": learned.error, "seconds": time}
    return Answer(content, text)


def _training_summary(folder: str, scene: str, record: Mapping[str, Any]) -> str:
    """Return a text on the training, and on the error at FEM runs that were held out."""
    plan = record["plan"]
    counts = [f"{plan['simulations']} FEM runs"] if plan.get("simulations") else []
    if "sweeps" in record:
        solved = "one" if record["sweeps"].get("fem_solutions") else "no"
        counts = [f"{solved} FEM run, {plan['sweeps']} sweeps"]
    counts += [f"{plan['steps']} steps"] if "steps" in plan else []
    text = f"trained {scene}: {', '.join([*counts, f'{record["seconds"]:.0f} s'])}"
    choice = record.get("discrepancy") or {}
    error = choice.get("held_out_err_u_mm", {}).get(choice.get("on"))
    if "sweeps" in record and "steps" not in plan:
        usual, most = (record["sweeps"][name] for name in ("error_mm", "largest_error_mm"))
        text += f"; {usual:.1g} mm from equilibrium, {most:.1g} mm at the worst theta tried"
    if "equilibrium" in record:
        return f"{text}\n{_distance(record['equilibrium'])}"
    if error is None:
        return f"{text}; errors of forces, volumes and strains: calibrate evaluate {folder}"
    text += f"; {error:.2g} mm from FEM at held-out runs"
    held_out = choice.get("held_out", {})
    of = f"N of up to {held_out.get('max_R', {}).get('max', 0.0):.2g} N in the force of a support"
    words = {"err_R": of, "err_V": "% of a cavity", "err_E": "in strain"}
    worst = [f"{held_out[n]['max']:.2g} {what}" for n, what in words.items() if n in held_out]
    return f"{text}, at worst {', '.join(worst)}" if worst else text


def _distance(record: Mapping[str, Any]) -> str:
    """Return a sentence on a network's error at theta that no training has seen."""
    count, known = record["theta"], record["known"]
    if not known:
        return (
            f"error: not known by Newton's step at any of {count} theta drawn anew, so far from "
            "equilibrium is the network; give more time"
        )
    error, energy = record["error_mm"], record["energy_percent"]
    text = (
        f"error by Newton's step at {known} of {count} theta drawn anew: {error['median']:.2g} mm, "
        f"{error['max']:.2g} mm at worst; potential energy {energy['median']:.1g} % above the least"
    )
    if known < count:
        text += f"; not known at {count - known}, where it is larger: give more time"
    return text


def _plan_entries(arguments: Namespace) -> dict[str, Any]:
    """Return the plan's fields from the command line; ``--resume`` allows a budget only."""
    options = [name for name in (*_ENTRIES, "recipe") if getattr(arguments, name) is not None]
    if arguments.resume and options:
        raise InputError(f"--{options[0]} has no effect with --resume: the checkpoint has its plan")
    return {name: getattr(arguments, name) for name in options if name in _ENTRIES}


def _plan(name: str, entries: Mapping[str, Any], budget: str | None) -> Plan:
    """Return the recipe called ``name`` with the options ``entries``; refuse one without effect.

    Zero steps are what a recipe without a network takes.
    """
    from emulator.training import recipe

    plan: Plan = recipe(name)
    names = {option.name for option in fields(plan)}
    if "steps" not in names and entries.get("steps") == 0:
        entries = {word: value for word, value in entries.items() if word != "steps"}
    plan = replace(plan, **{word: value for word, value in entries.items() if word in names})
    unused = _unused(plan)
    for word in [*entries, *([] if budget is None else ["budget"])]:
        if word in unused:
            raise InputError(
                f"--{word} has no effect with recipe '{plan.recipe}', which {unused[word]}; "
                "leave it out"
            )
    return plan


def _unused(plan: Plan) -> dict[str, str]:
    """Return the options that change nothing under ``plan``, and why."""
    names = {option.name for option in fields(plan)}
    network = (
        "learns from all equilibria at every step" if plan.trains_network else "trains no network"
    )
    reasons = {
        "steps": network,
        "batch": network,
        "simulations": "takes no FEM runs",
        "sweeps": "makes none",
    }
    unused = {name: reason for name, reason in reasons.items() if name not in names}
    if not plan.runs and "sweeps" not in names:
        unused["simulations"] = reasons["simulations"]
    return unused


def _command_line(scene: str, record: Mapping[str, Any]) -> str:
    """Return the command that repeats a training exactly, with its actual steps and runs."""
    from emulator.training.trainer import plan_of

    options, unused = record["plan"], _unused(plan_of(record["plan"]))
    words = [
        f"--{name} {options[name]}"
        for name in ("recipe", *_ENTRIES)
        if name in options and name not in unused
    ]
    # The record names the emulator training started from by its fingerprint, not by its folder.
    start = " --start EMULATOR" if "start" in record else ""
    campaign = " --campaign STORE.zarr" if options["campaign"] else ""
    return f"calibrate train {scene} {' '.join(words)}{start}{campaign} --out DIR"


@command(
    option("model", "MODEL", "TwistingBeam, Liver or LeftVentricle"),
    option("--root", "DIR", "a clone of the release, or its folder data", required=True),
    option("--out", "DIR", required=True),
    help="make an emulator of a network released with Dalton et al. (2023)",
    description="Read a released network and write it as an emulator, which evaluate, predict, "
    "infer and certify take like any other.",
)
def released(arguments: Namespace) -> Answer:
    """Read, check and write the network."""
    from emulator.surrogates import save_emulator
    from emulator.surrogates.released_network import released_network

    check_folder(arguments.out)
    emulator = released_network(arguments.model, arguments.root)
    save_emulator(emulator, arguments.out)
    scene = emulator.scene
    result = {
        "scene": scene.name,
        "parameters": list(scene.parameter_names),
        "fingerprint": emulator.fingerprint,
        "out": arguments.out,
    }
    names = ", ".join(scene.parameter_names)
    text = f"{scene.name}: the released network, theta is {names}\nwritten: {arguments.out}"
    return Answer(result, text)
