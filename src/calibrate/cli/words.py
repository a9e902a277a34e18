"""Commands, the options that several of them share, and how their words are read."""

from __future__ import annotations

import inspect
import re
from argparse import Action, ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from emulator.core.errors import InputError
from emulator.core.store import check_folder

if TYPE_CHECKING:
    import jax

    from emulator.scenes.forward_problem import ForwardProblem
    from emulator.scenes.scene import Scene


class _Once(Action):
    """The action of an option: its value, or all of them where it takes several and is repeated.

    ``argparse`` keeps the last value of a repeated option, and drops the others without a word.
    """

    def __call__(self, parser: Any, namespace: Any, values: Any, option: str | None = None) -> None:
        """Keep the value; a second one is added to the first, or refused."""
        seen = namespace.__dict__.setdefault(_SEEN, set())
        if self.dest in seen and option is not None:
            if self.nargs not in ("+", "*"):
                parser.error(f"{option} is given twice; give it once")
            values = [*getattr(namespace, self.dest), *values]
        seen.add(self.dest)
        setattr(namespace, self.dest, values)


_SEEN = "_options_seen"


class Parser(ArgumentParser):
    """An argument parser whose errors are one line, and in which a repeated option is not lost."""

    def __init__(self, *arguments: Any, **about: Any) -> None:
        super().__init__(*arguments, **about)
        for name in (None, "store"):
            self.register("action", name, _Once)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as :mod:`argparse` does, without its record of repeated options."""
        arguments, rest = super().parse_known_args(args, namespace)
        if hasattr(arguments, _SEEN):
            delattr(arguments, _SEEN)
        return arguments, rest

    def error(self, message: str) -> NoReturn:
        """Raise the message as an :class:`InputError`."""
        raise InputError(f"{message} (see {self.prog} --help)")


class Answer(NamedTuple):
    """The result of a command, as JSON and as text.

    usable : whether the result may be used: the exit code is 0, or 1.
    then : what is to be done once the result is printed.
    """

    result: Any
    text: str
    usable: bool = True
    then: Callable[[], None] | None = None


Option = Callable[[ArgumentParser], object]
"""Adds options to the parser of a command."""


Command = Callable[[Any, str], None]
"""Adds a command, called so, to the commands of a parser."""


def command(*options: Option, **about: str) -> Callable[[Callable[[Namespace], Answer]], Command]:
    """Make a command of the function that answers it.

    Parameters
    ----------
    options : what the command takes; ``--json`` comes last, unless it is among them.
    about : its help, description and epilog, as :mod:`argparse` takes them.
    """

    def made_of(run: Callable[[Namespace], Answer]) -> Command:
        def add(commands: Any, name: str) -> None:
            parser = commands.add_parser(name, **about)
            for add_option in options if JSON in options else (*options, JSON):
                add_option(parser)
            parser.set_defaults(run=run)

        return add

    return made_of


def command_of_kinds(about: str, **kinds: Command) -> Command:
    """Make a command whose second word names one of several ``kinds``."""

    def add(commands: Any, name: str) -> None:
        parser = commands.add_parser(name, help=about)
        names = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
        for kind, add_kind in kinds.items():
            add_kind(names, kind)

    return add


def option(flag: str, metavar: Any = None, help: str | None = None, **about: Any) -> Option:
    """Return the function that adds one option, with the arguments of :mod:`argparse`."""
    return lambda parser: parser.add_argument(flag, metavar=metavar, help=help, **about)


def flag(name: str, text: str) -> Option:
    """Return the function that adds an option without a value."""
    return lambda parser: parser.add_argument(name, action="store_true", help=text)


JSON = flag("--json", "print the result as JSON")
THETA = option("--theta", "NAME=VALUE", "default: the box's centre", nargs="+", default=[])


def seed_option(what: str) -> Option:
    """Return ``--seed``; ``what`` is drawn from it."""
    return option("--seed", type=int, default=0, help=f"seed of {what} (default 0)")


def load_steps_option(default: int | None = 1) -> Option:
    """Return ``--load-steps``; without a ``default`` it is the run's."""
    usual = "the run's own" if default is None else default
    text = f"follow the loading path; a very soft body has several equilibria (default {usual})"
    return option("--load-steps", "N", text, type=int, default=default)


def engine_option() -> Option:
    """Return ``--engine``, by default the run's."""
    from emulator.core.engine import USAGE

    return option("--engine", "WORDS", f"what does many solves: {USAGE} (default the run's own)")


def parameters(function: Callable[..., Any], arguments: Namespace) -> dict[str, Any]:
    """Return the words of the options that are called as parameters of ``function``."""
    names = inspect.signature(function).parameters
    return {name: word for name, word in vars(arguments).items() if name in names}


def add_scene(parser: ArgumentParser, more: str = "") -> None:
    """Add the scene and the folder of published ones; ``more`` ends the scene's help."""
    parser.add_argument(
        "scene",
        metavar="SCENE",
        help="built-in name, .toml file, or published:<Model>; finer:SCENE refines its mesh" + more,
    )
    parser.add_argument("--root", metavar="DIR", help="folder of the published data")


def scene_words(arguments: Namespace) -> tuple[str, str | None]:
    """Return the name and the folder (of published scenes) that :func:`add_scene` read."""
    is_published = "published:" in arguments.scene
    if arguments.root is not None and not is_published:
        raise InputError(
            f"--root has no effect with scene '{arguments.scene}': it is the folder of the "
            "published data, for published:<Model>"
        )
    return arguments.scene, arguments.root


def problem_of(arguments: Namespace) -> ForwardProblem:
    """Return the scene or the specimen that :func:`add_scene` read."""
    from emulator.catalogue import find_problem

    return find_problem(*scene_words(arguments))


def scene_of(arguments: Namespace) -> Scene:
    """Return the scene that :func:`add_scene` read; :class:`InputError` for a specimen."""
    from emulator.scenes.scene import with_mesh

    return with_mesh(problem_of(arguments))


def theta_of(arguments: Namespace, scene: ForwardProblem) -> jax.Array:
    """Return the theta (p,) of :data:`THETA`, inside the scene's box."""
    return scene.theta(**assignments(arguments.theta)) if arguments.theta else scene.centre


def add_forward(parser: ArgumentParser, default: str | None = "emulator") -> None:
    """Add ``--forward`` and every option of every kind in the registry."""
    from emulator.surrogates.registry import FORWARD_MAPS, known_options

    kinds = "; ".join(f"{kind.name}: {kind.help}" for kind in FORWARD_MAPS.values())
    parser.add_argument("--forward", choices=tuple(FORWARD_MAPS), default=default, help=kinds)
    for option, _ in known_options().values():
        text = f"{option.help} (default {option.default})"
        parser.add_argument(option.flag, type=int, metavar="N", help=text)


def forward_options(arguments: Namespace) -> dict[str, int]:
    """Return the options of a forward map that :func:`add_forward` read."""
    from emulator.surrogates.registry import known_options

    words = {name: getattr(arguments, name) for name in known_options()}
    return {name: value for name, value in words.items() if value is not None}


def assignments(words: Sequence[str]) -> dict[str, float]:
    """Read ``name=number`` words; :class:`InputError` for other words or a repeated name."""
    values: dict[str, float] = {}
    for word in words:
        name, _, text = word.partition("=")
        if name in values:
            raise InputError(f"'{name}' is given twice; once is enough")
        try:
            values[name] = float(text)
        except ValueError as error:
            raise InputError(f"'{word}' is not name=number, e.g. mu=73") from error
    return values


_DURATION = re.compile(r"(?:(\d+(?:\.\d+)?)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s)?", re.ASCII)


def seconds(text: str) -> float:
    """Read a duration such as ``90s``, ``15m``, ``2h`` or ``1h30m``, in seconds."""
    match = _DURATION.fullmatch(text)
    if match is None or not text:
        bare = text.strip().isdigit()
        hint = f"{text.strip()} what? give {text.strip()}s or {text.strip()}m" if bare else ""
        raise InputError(f"duration '{text}': {hint or 'give 90s, 15m, 2h or 1h30m, no blanks'}")
    hours, minutes, rest = (float(part or 0.0) for part in match.groups())
    value = 3600.0 * hours + 60.0 * minutes + rest
    if not 0.0 < value < float("inf"):
        raise InputError(f"duration '{text}' must be above 0")
    return value


def check_vtu(path: str) -> None:
    """Refuse a file to write that is not a ``.vtu``, or cannot be written, before the work."""
    if not path.endswith(".vtu"):
        raise InputError(f"--out {path}: the file name must end in .vtu")
    check_folder(Path(path).parent)
