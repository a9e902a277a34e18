"""A run on the command line: the options are generated from :class:`~calibrate.project.run.Run`.

The name, the type, the default and the description of an option are those of the run's field.
:data:`WORDS` says how an option is written where that does not follow from the field. Options
without a word given leave the run's default, or the entry of an experiment file, as it is.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, dataclass, fields
from typing import Any, get_type_hints

from calibrate.cli.words import add_forward, add_scene, assignments, forward_options, scene_words
from calibrate.noise import NOISES, parse_noise
from calibrate.project.experiment import is_experiment_file, read_experiment
from calibrate.project.members import Members
from calibrate.project.problem import Problem, read_problem
from calibrate.project.run import SYNTHETIC, Run, with_absolute_paths
from calibrate.samplers import SAMPLERS
from emulator.core.docstrings import documented
from emulator.core.errors import InputError

NoiseWord = float | dict[str, Any]

SAMPLING = ("sampler", "sampler_options", "warmup", "draws", "chains", "seed")
"""Fields of a run that say how it is sampled."""

MODEL = (
    "data", "truth", "known", "observe", "prior", "noise", "noise_scale", "discrepancy",
    "check_scale", "forward", "emulator", "error_runs", "mesh_error_runs", "load_steps",
)  # fmt: skip
"""Fields of a run that say which posterior is meant, besides its scene (:func:`add_scene`) and the
forward map's options (:func:`add_forward`); ``systematic`` errors need an experiment file."""


@dataclass(frozen=True)
class Word:
    """How the command line writes one field of a :class:`Run`.

    metavar : the name of the option's value in the help.
    help : the option's help where it differs from the field's description.
    flag : the option where it is not the field's name.
    read : how several words become the field's value; by default there is one word.
    """

    metavar: str | None = None
    help: str | None = None
    flag: str | None = None
    read: Callable[[Sequence[str]], Any] | None = None


def add_run(parser: argparse.ArgumentParser, more: Sequence[str] = ()) -> None:
    """Add the options of a run's scene and :data:`MODEL`, and of ``more`` of its fields."""
    add_scene(parser, "; or an experiment file, whose entries the options replace")
    exclusive = parser.add_mutually_exclusive_group()
    for field in fields(Run):
        if field.name == "forward":
            add_forward(parser, default=None)
        elif field.name in (*MODEL, *more):
            group = exclusive if field.name.endswith("error_runs") else parser
            word = WORDS.get(field.name, Word())
            flag = word.flag or f"--{field.name.replace('_', '-')}"
            group.add_argument(flag, dest=field.name, **_argument(field, word))


def _argument(field: Field[Any], word: Word) -> dict[str, Any]:
    """Return the arguments of ``add_argument`` for one field of a run."""
    hint, has_default = get_type_hints(Run)[field.name], field.default not in (MISSING, None)
    description = documented(Run)[field.name].removesuffix(".").replace("%", "%%")
    usual = f" (default {field.default})" if has_default else ""
    text = {"help": word.help or f"{description}{usual}"}
    if hint is bool:
        return {"action": "store_const", "const": not field.default, **text}
    if word.read is not None:
        return {"nargs": "+", "default": [], "metavar": word.metavar, **text}
    if field.name == "sampler":
        return {"choices": tuple(SAMPLERS), "help": f"default {field.default}"}
    if hint is int:
        return {"type": int, "metavar": "N", **text}
    return {"metavar": word.metavar, **text}


def entries_of(arguments: argparse.Namespace, more: Sequence[str] = ()) -> dict[str, Any]:
    """Return the fields of a run that :func:`add_run` read: those that an option was given for."""
    has_data_file = arguments.data not in (None, SYNTHETIC)
    for option in ("truth", "observe") if has_data_file else ():
        if getattr(arguments, option):
            raise InputError(
                f"--{option} has no effect beside --data {arguments.data}: it is for synthetic data"
            )
    entries: dict[str, Any] = {}
    for name in (*MODEL, *more):
        read = WORDS[name].read if name in WORDS else None
        word = getattr(arguments, name)
        entries[name] = word if read is None else read(word)
    entries["forward_options"] = forward_options(arguments)
    if is_experiment_file(arguments.scene):
        entries["root"] = arguments.root
    else:
        entries["scene"], entries["root"] = scene_words(arguments)
    nonempty = {name: value for name, value in entries.items() if value is not None and value != {}}
    return with_absolute_paths(nonempty)


def plan_of(arguments: argparse.Namespace, more: Sequence[str] = ()) -> Problem | Members:
    """Read what :func:`add_run` read: the problem of one run, or an experiment file's members."""
    entries = entries_of(arguments, more)
    if is_experiment_file(arguments.scene):
        return read_experiment(arguments.scene, entries)
    return read_problem(Run(**entries))


def problem_of(arguments: argparse.Namespace, more: Sequence[str] = ()) -> Problem:
    """Return :func:`plan_of` of one run; :class:`InputError` if it is of members."""
    plan = plan_of(arguments, more)
    if isinstance(plan, Members):
        raise InputError(
            f"{arguments.scene} has members of a population; give an experiment file of one of them"
        )
    return plan


def noise_words(words: Sequence[str]) -> dict[str, NoiseWord] | float:
    """Read ``--noise``: numbers, or kinds of noise with their options, by the observation's name.

    A single bare number is returned as it is: which observation it belongs to depends on the data.
    Beside named values, a bare number is the displacements'.
    """
    for word in words:
        if word.partition(":")[0] in NOISES:
            raise InputError(f"--noise: '{word}' needs a name, as in displacement={word}")
    if len(words) == 1 and "=" not in words[0]:
        return _number(words[0], "--noise")
    return _by_name(words, "--noise", parse_noise)


def noise_scale_words(words: Sequence[str]) -> dict[str, float] | float:
    """Read ``--noise-scale``: numbers as in :func:`noise_words`."""
    if len(words) == 1 and "=" not in words[0]:
        return _number(words[0], "--noise-scale")
    return _by_name(words, "--noise-scale", float)


def discrepancy_words(words: Sequence[str]) -> dict[str, dict[str, float]]:
    """Read ``--discrepancy``: scale and correlation length, ``SCALE:LENGTH``, by name."""
    return _by_name(words, "--discrepancy", _discrepancy)


def _discrepancy(text: str) -> dict[str, float]:
    scale, length = map(float, text.split(":"))
    return {"scale": scale, "length": length}


def _by_name[T](words: Sequence[str], option: str, read: Callable[[str], T]) -> dict[str, T]:
    values: dict[str, T] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            name, text = "displacement", word
        if name in values and not equals:
            raise InputError(f"{option}: '{word}' needs a name, as in volume={word}")
        if name in values:
            raise InputError(f"{option}: '{name}' is given twice; once is enough")
        try:
            values[name] = read(text)
        except InputError as error:
            raise InputError(f"{option}: {error}") from error
        except ValueError as error:
            right = {"--discrepancy": "displacement=0.5:20"}.get(option, "volume=1.0")
            raise InputError(f"{option}: '{word}' is wrong; write it as in {right}") from error
    return values


def _number(word: str, option: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise InputError(f"{option}: '{word}' is not a number") from error


def sampler_options(words: Sequence[str]) -> dict[str, Any]:
    """Read ``--sampler-options``; a value is a whole number, a number or a word, as it reads."""
    options: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not (name and equals and text):
            raise InputError(
                f"--sampler-options: '{word}' is not NAME=VALUE, as target_accept=0.95"
            )
        options[name] = text
        for kind in (float, int):  # an int where the text is one
            with suppress(ValueError):
                options[name] = kind(text)
    return options


def check_warmup(problem: Problem, arguments: argparse.Namespace) -> None:
    """Raise :class:`InputError` if ``--warmup`` is given to a sampler that does not adapt."""
    sampler, _ = problem.run.sampling()
    adapts = "warmup" in {field.name for field in fields(sampler.options)}
    if arguments.warmup is not None and not adapts:
        raise InputError(
            f"--warmup has no effect with sampler '{sampler.name}', which does not adapt"
        )


WORDS = {
    "data": Word("FILE|synthetic", ".csv or netCDF, mm and mL (default synthetic)"),
    "truth": Word(
        "NAME=VALUE",
        "parameters of synthetic data; NAME@STATE=VALUE in one of several load states",
        read=assignments,
    ),
    "known": Word(
        "NAME=VALUE", "parameters that are not inferred, e.g. pressure@p8=1.07", read=assignments
    ),
    "observe": Word(
        "WHAT",
        "observations of synthetic data (default nodes:20), e.g. nodes:N, landmarks:N, all, a node "
        "set, 3,14,15, volume, volume:FACETSET, surface:FACETSET:N, strain:fibre:N, "
        "segment_strain:circumferential, length:A:B, parameter:NAME; several joined by +, as in "
        "landmarks:24+volume",
    ),
    "prior": Word(
        "NAME|FILE",
        "box (uniform over the scene's range; the default), ventricles (correlated "
        "Holzapfel-Ogden parameters of human ventricles), or a population's medians, log sds and "
        "correlations in a .json file",
    ),
    "noise": Word(
        "[NAME=]SD",
        "standard deviation by observation, e.g. volume=1.0 displacement=0.2, mL and mm; a bare "
        "number is a single observation's or the displacements' (default 0.2 mm, 1 mL). Other "
        "noise by its name, e.g. displacement=student_t:dof=4,scale=0.2 or "
        "displacement=correlated:length=15,sd=0.1,spatial_sd=0.2 (length in mm)",
        read=noise_words,
    ),
    "noise_scale": Word(
        "[NAME=]SCALE",
        "infer the noise: scale of the half-normal prior of its standard deviation",
        read=noise_scale_words,
    ),
    "discrepancy": Word(
        "NAME=SCALE:LENGTH",
        "let the model be wrong, e.g. displacement=0.5:20: scale of the half-normal prior of the "
        "discrepancy's standard deviation, in the data's unit, and its correlation length, mm",
        read=discrepancy_words,
    ),
    "check_scale": Word(
        flag="--no-unit-check",
        help="take data however far from every prediction (m for mm, mm3 for mL, zero)",
    ),
    "emulator": Word("NAME|DIR"),
    "mesh_error_runs": Word(flag="--mesh-error"),
    "sampler_options": Word(
        "NAME=VALUE",
        "e.g. target_accept=0.95, start=pathfinder; an unknown name lists the sampler's",
        read=sampler_options,
    ),
}
"""How the command line writes fields of a run that are not one word called as the field."""
