"""Options that several commands share, each declared once, and how their words are read."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from emulator.core.errors import InputError
from emulator.core.store import check_folder

if TYPE_CHECKING:
    import jax

    from emulator.scenes.scene import Scene
    from emulator.surrogates.emulator import Emulator

COMMAND_NAME = "calibrate"


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Raise the message as an :class:`InputError`."""
        raise InputError(f"{message} (see {self.prog} --help)")


def answer(parser: argparse.ArgumentParser, run: Callable[[argparse.Namespace], int]) -> None:
    """Have ``run`` answer a command, with ``--json``, which every command has."""
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.set_defaults(run=run)


def add_scene(parser: argparse.ArgumentParser, more: str = "") -> None:
    """Add the scene and the folder of published ones; ``more`` ends the scene's help."""
    parser.add_argument(
        "scene",
        metavar="SCENE",
        help="built-in name, .toml file, or published:<Model>; finer:SCENE refines its mesh" + more,
    )
    parser.add_argument("--root", metavar="DIR", help="folder of the published data")


def scene_words(arguments: argparse.Namespace) -> tuple[str, str | None]:
    """Return the name and the folder that :func:`add_scene` read.

    Raises
    ------
    InputError
        A folder is given, and the scene is not a published one.
    """
    is_published = arguments.scene.removeprefix("finer:").startswith("published:")
    if arguments.root is not None and not is_published:
        raise InputError(
            f"--root has no effect with scene '{arguments.scene}': it is the folder of the "
            "published data, for published:<Model>"
        )
    return arguments.scene, arguments.root


def scene_of(arguments: argparse.Namespace) -> Scene:
    """Return the scene that :func:`add_scene` read."""
    from emulator.catalogue import find_scene

    return find_scene(*scene_words(arguments))


def add_theta(parser: argparse.ArgumentParser) -> None:
    """Add one theta."""
    parser.add_argument(
        "--theta", nargs="+", default=[], metavar="NAME=VALUE", help="default: the box's centre"
    )


def theta_of(arguments: argparse.Namespace, scene: Scene) -> jax.Array:
    """Return the theta (p,) that :func:`add_theta` read, inside the scene's box."""
    return scene.theta(**assignments(arguments.theta)) if arguments.theta else scene.centre


def theta_by_name(scene: Scene, theta: Any) -> dict[str, float]:
    """Return a theta (p,) as a result has it."""
    return dict(zip(scene.parameter_names, map(float, theta), strict=True))


def add_load_steps(parser: argparse.ArgumentParser, default: int | None = 1) -> None:
    """Add ``--load-steps``; without a ``default`` it is the run's."""
    usual = "the run's own" if default is None else default
    parser.add_argument(
        "--load-steps",
        type=int,
        default=default,
        metavar="N",
        help=f"follow the loading path; a very soft body has several equilibria (default {usual})",
    )


def add_seed(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--seed``; ``what`` is drawn from it."""
    parser.add_argument("--seed", type=int, default=0, help=f"seed of {what} (default 0)")


def add_scheduler(parser: argparse.ArgumentParser, which: str) -> None:
    """Add ``--scheduler``; ``which`` names the solves that go there."""
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help=f"{which} on the workers of this Dask scheduler, e.g. tcp://127.0.0.1:8786",
    )


def scheduler_word(arguments: argparse.Namespace) -> str | None:
    """Return the address that :func:`add_scheduler` read; :class:`InputError` for another word."""
    if arguments.scheduler is not None:
        from emulator.fem.campaign.cluster import check_address

        check_address(arguments.scheduler)
    return arguments.scheduler


def add_forward(parser: argparse.ArgumentParser, default: str | None = "emulator") -> None:
    """Add ``--forward`` and every option of every kind in the registry."""
    from emulator.surrogates.registry import FORWARD_MAPS, known_options

    kinds = "; ".join(f"{kind.name}: {kind.help}" for kind in FORWARD_MAPS.values())
    parser.add_argument("--forward", choices=tuple(FORWARD_MAPS), default=default, help=kinds)
    for option, _ in known_options().values():
        text = f"{option.help} (default {option.default})"
        parser.add_argument(option.flag, type=int, metavar="N", help=text)


def forward_options(arguments: argparse.Namespace) -> dict[str, int]:
    """Return the options of a forward map that :func:`add_forward` read."""
    from emulator.surrogates.registry import known_options

    words = {name: getattr(arguments, name) for name in known_options()}
    return {name: value for name, value in words.items() if value is not None}


def checked_forward_options(arguments: argparse.Namespace) -> dict[str, int]:
    """Return :func:`forward_options`; :class:`InputError` where the map has no such option."""
    from emulator.surrogates.registry import full_options

    options = forward_options(arguments)
    full_options(arguments.forward, options)
    return options


def add_body(parser: argparse.ArgumentParser) -> None:
    """Add an emulator or a scene, and the scene's emulator."""
    parser.add_argument(
        "body", metavar="EMULATOR|SCENE", help="an emulator's shipped name or folder, or a scene"
    )
    parser.add_argument(
        "--emulator", metavar="E", help="the scene's emulator: shipped name or folder"
    )


def emulator_of(arguments: argparse.Namespace) -> Emulator:
    """Return the emulator that :func:`add_body` read."""
    from emulator.catalogue import find_scene
    from emulator.surrogates import load

    body, word = arguments.body, arguments.emulator
    emulator = load(word or body)
    if word and find_scene(body).fingerprint != emulator.scene.fingerprint:
        raise InputError(
            f"--emulator {word} is of scene '{emulator.scene.name}', or of another mesh, not of "
            f"'{body}'"
        )
    return emulator


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
