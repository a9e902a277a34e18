"""A run on the command line: the options are generated from :class:`~calibrate.project.run.Run`.

The name, the type, the default and the description of an option are those of the run's field.
:data:`WORDS` says how an option is written where that does not follow from the field. Options
without a word given leave the run's default, or the entry of an experiment file, as it is.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Any, get_type_hints

from calibrate.cli.words import (
    Option,
    add_forward,
    add_scene,
    assignments,
    forward_options,
    scene_words,
)
from emulator.core.errors import InputError

if TYPE_CHECKING:
    from calibrate.project import Problem, Run
    from calibrate.project.members import Members

NoiseWord = float | dict[str, Any]

MODEL = (
    "data", "truth", "known", "observe", "prior", "bounded", "noise", "noise_scale",
    "check_scale", "forward", "emulator", "load_steps", "engine",
)  # fmt: skip
"""Fields of a run that say which posterior is meant, besides its scene (:func:`add_scene`) and the
forward map's options (:func:`add_forward`); ``systematic`` errors need an experiment file."""


@dataclass(frozen=True)
class Word:
    """How the command line writes one field of a :class:`Run`.

    metavar : the name of the option's value in the help.
    help : the option's help where it differs from the field's description; ``{observations}`` and
        ``{noises}`` stand for the words of their kinds.
    flag : the option where it is not the field's name.
    read : how several words become the field's value; by default there is one word.
    """

    metavar: str | None = None
    help: str | None = None
    flag: str | None = None
    read: Callable[[Sequence[str]], Any] | None = None


def run_options(*more: str) -> Option:
    """Return the options of a run's scene and :data:`MODEL`, and of ``more`` of its fields."""
    return partial(_add_run, more=more)


def _add_run(parser: ArgumentParser, more: Sequence[str]) -> None:
    from calibrate.measurements import OBSERVATIONS
    from calibrate.measurements.words import usage_of
    from calibrate.noise import NOISES
    from calibrate.noise import usage_of as usage_of_noise
    from calibrate.project.run import Run
    from emulator.core.schema import documented

    add_scene(parser, "; or an experiment file, whose entries the options replace")
    parser.set_defaults(fields=(*MODEL, *more))
    hints, texts = get_type_hints(Run), documented(Run)
    for field in fields(Run):
        name, default = field.name, field.default
        if name == "forward":
            add_forward(parser, default=None)
        elif name in (*MODEL, *more):
            word = WORDS.get(name, Word())
            usual = "" if default in (MISSING, None) else f" (default {default})"
            text = f"{texts[name].removesuffix('.').replace('%', '%%')}{usual}"
            if word.help is not None:
                text = word.help.format(
                    observations="; ".join(
                        usage_of(kind).partition(";")[0] for kind in OBSERVATIONS.values()
                    ),
                    noises="; ".join(map(usage_of_noise, NOISES.values())),
                )
            about: dict[str, Any] = {"metavar": word.metavar}
            if hints[name] is bool:
                about = {"action": "store_const", "const": not default}
            elif word.read is not None:
                about |= {"nargs": "+", "default": []}
            elif name == "sampler":
                from calibrate.samplers import SAMPLERS

                about, text = {"choices": tuple(SAMPLERS)}, f"default {default}"
            elif hints[name] is int:
                about = {"type": int, "metavar": "N"}
            flag = word.flag or f"--{name.replace('_', '-')}"
            parser.add_argument(flag, dest=name, help=text, **about)


def plan_of(arguments: Namespace) -> Run | Problem | Members:
    """Return the run, or the experiment file's problem or members, from :func:`run_options`."""
    from calibrate.project.experiment import (
        is_experiment_file,
        read_experiment,
        with_absolute_paths,
    )
    from calibrate.project.run import SYNTHETIC, Run

    has_data_file = arguments.data not in (None, SYNTHETIC)
    for option in ("truth", "observe") if has_data_file else ():
        if getattr(arguments, option):
            raise InputError(
                f"--{option} has no effect beside --data {arguments.data}: it is for synthetic data"
            )
    entries: dict[str, Any] = {}
    for name in arguments.fields:
        read, word = WORDS.get(name, Word()).read, getattr(arguments, name)
        entries[name] = word if read is None else read(word)
    entries["forward_options"] = forward_options(arguments)
    in_file = is_experiment_file(arguments.scene)
    if in_file:
        entries["root"] = arguments.root
    else:
        entries["scene"], entries["root"] = scene_words(arguments)
    # An option that is not given leaves the run's default, or the file's entry, as it is.
    nonempty = {name: value for name, value in entries.items() if value is not None and value != {}}
    run_fields = with_absolute_paths(nonempty)
    return read_experiment(arguments.scene, run_fields) if in_file else Run(**run_fields)


def problem_of(arguments: Namespace) -> Problem:
    """Return the problem of :func:`plan_of`; :class:`InputError` if it is of members."""
    from calibrate.project import Problem, Run, read_problem

    plan = plan_of(arguments)
    if not isinstance(plan, Run | Problem):
        raise InputError(
            f"{arguments.scene} has members of a population; give an experiment file of one of them"
        )
    return read_problem(plan)


def noise_words(words: Sequence[str]) -> dict[str, NoiseWord] | float:
    """Read ``--noise``: numbers, or kinds of noise with their options, by the observation's name.

    A single bare number is returned as it is: which observation it belongs to depends on the data.
    Beside named values, a bare number is the displacements'.
    """
    from calibrate.noise import NOISES, parse_noise

    for word in words:
        if word.partition(":")[0] in NOISES:
            raise InputError(f"--noise: '{word}' needs a name, as in displacement={word}")
    return _by_name(words, "--noise", parse_noise)


def noise_scale_words(words: Sequence[str]) -> dict[str, float] | float:
    """Read ``--noise-scale``: numbers as in :func:`noise_words`."""
    return _by_name(words, "--noise-scale", float)


def _by_name[T](
    words: Sequence[str], option: str, read: Callable[[str], T]
) -> dict[str, T] | float:
    """Read values by name; return a number that stands alone as it is."""
    if len(words) == 1 and "=" not in words[0]:
        try:
            return float(words[0])
        except ValueError as error:
            raise InputError(f"{option}: '{words[0]}' is not a number") from error
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
            raise InputError(f"{option}: '{word}' is wrong; write it as in volume=1.0") from error
    return values


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
        "observations of synthetic data (default nodes:20): {observations}; several joined by +, "
        "as in landmarks:24+volume",
    ),
    "prior": Word(
        "NAME|FILE",
        "box (uniform over the scene's range; the default), ventricles (correlated "
        "Holzapfel-Ogden parameters of human ventricles), or a population's medians, log sds and "
        "correlations in a .json file",
    ),
    "bounded": Word("NAME", "parameters whose range ends where nature does", read=tuple),
    "noise": Word(
        "[NAME=]SD",
        "standard deviation by observation, e.g. volume=1.0 displacement=0.2, mL and mm; a bare "
        "number is a single observation's or the displacements' (default 0.2 mm, 1 mL, less for a "
        "small body). Other noise as displacement=KIND:..., {noises}",
        read=noise_words,
    ),
    "noise_scale": Word(
        "[NAME=]SCALE",
        "infer the noise: scale of the half-normal prior of its standard deviation",
        read=noise_scale_words,
    ),
    "check_scale": Word(
        flag="--no-unit-check",
        help="take data however far from every prediction (m for mm, mm3 for mL, zero)",
    ),
    "emulator": Word("NAME|DIR"),
    "sampler_options": Word(
        "NAME=VALUE",
        "e.g. target_accept=0.95, rounds=2; an unknown name lists the sampler's",
        read=sampler_options,
    ),
}
"""How the command line writes fields of a run that are not one word called as the field."""
