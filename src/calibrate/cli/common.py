"""Helpers that all commands use."""

from __future__ import annotations

import argparse
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from emulator.core.errors import InputError
from emulator.core.store import check_folder, to_json

DONE, FAILED, BAD_INPUT = 0, 1, 2


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
    """Add the scene and, for published ones, the folder of the data; ``more`` it may be."""
    parser.add_argument(
        "scene",
        metavar="SCENE",
        help="built-in name, .toml file, or published:<Model>; finer:SCENE refines its mesh" + more,
    )
    parser.add_argument("--root", metavar="DIR", help="folder of the published data")


def scene_words(arguments: argparse.Namespace) -> tuple[str, str | None]:
    """Name and folder that :func:`add_scene` read; a folder belongs to published scenes alone."""
    if arguments.root is not None and not _published(arguments.scene):
        raise InputError(
            f"--root has no effect with scene '{arguments.scene}': it is the folder of the "
            "published data, for published:<Model>"
        )
    return arguments.scene, arguments.root


def _published(scene: str) -> bool:
    return scene.removeprefix("finer:").startswith("published:")


def add_theta(parser: argparse.ArgumentParser) -> None:
    """Add one theta."""
    parser.add_argument(
        "--theta", nargs="+", default=[], metavar="NAME=VALUE", help="default: the box's centre"
    )


def add_scheduler(parser: argparse.ArgumentParser, which: str) -> None:
    """Add ``--scheduler``; ``which`` names the solves that go there."""
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help=f"{which} on the workers of this Dask scheduler, e.g. tcp://127.0.0.1:8786",
    )


def scheduler_word(arguments: argparse.Namespace) -> str | None:
    """The address that :func:`add_scheduler` read; :class:`InputError` for what is none."""
    if arguments.scheduler is not None:
        from emulator.fem.campaign.cluster import check_address

        check_address(arguments.scheduler)
    return arguments.scheduler


def assignments(words: Sequence[str]) -> dict[str, float]:
    """``name=number`` words as a dict; :class:`InputError` for other words or a repeated name."""
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
    """A duration such as ``90s``, ``15m``, ``2h`` or ``1h30m`` in seconds."""
    found = _DURATION.fullmatch(text)
    if found is None or not text:
        bare = text.strip().isdigit()
        hint = f"{text.strip()} what? give {text.strip()}s or {text.strip()}m" if bare else ""
        raise InputError(f"duration '{text}': {hint or 'give 90s, 15m, 2h or 1h30m, no blanks'}")
    hours, minutes, rest = (float(part or 0.0) for part in found.groups())
    value = 3600.0 * hours + 60.0 * minutes + rest
    if not 0.0 < value < float("inf"):
        raise InputError(f"duration '{text}' must be above 0")
    return value


@contextmanager
def needing_plotly(what: str) -> Iterator[None]:
    """Have a missing Plotly told in one line, that ``what`` needs it."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != "plotly":
            raise
        raise InputError(f"{what} plotly: pip install 'soft-tissue-calibrate[plot]'") from error


def check_vtu(path: str) -> None:
    """Refuse a file to write that is not a ``.vtu``, or cannot be written, before the work."""
    if not path.endswith(".vtu"):
        raise InputError(f"--out {path}: the file name must end in .vtu")
    check_folder(Path(path).parent)


def emit(result: Any, *, as_json: bool, text: str) -> None:
    """Print ``result`` as JSON, or ``text``."""
    print(to_json(result) if as_json else text)


def table(header: Sequence[str], rows: Iterable[Sequence[object]], width: int | None = None) -> str:
    """A table in text: the first column aligned to the left, the others to the right.

    Columns that do not fit ``width`` (by default the terminal's, if there is one) go below, with
    the first column again.
    """
    lines = [list(header), *([_cell(value) for value in row] for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]
    if width is None:
        width = shutil.get_terminal_size((_UNLIMITED, 24)).columns
    blocks = [
        "\n".join(_aligned(line, widths, columns) for line in lines)
        for columns in _blocks(widths, width)
    ]
    return "\n\n".join(blocks)


_UNLIMITED = 1_000_000  # columns of a file or a pipe


def _blocks(widths: Sequence[int], width: int) -> list[list[int]]:
    """Columns after the first that stand side by side; at least one a block."""
    blocks: list[list[int]] = [[]]
    for k in range(1, len(widths)):
        together = [0, *blocks[-1], k]
        if blocks[-1] and sum(widths[j] + 2 for j in together) - 2 > width:
            blocks.append([])
        blocks[-1].append(k)
    return blocks


def _aligned(line: Sequence[str], widths: Sequence[int], columns: Sequence[int]) -> str:
    cells = [line[0].ljust(widths[0]), *(line[k].rjust(widths[k]) for k in columns)]
    return "  ".join(cells).rstrip()


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)


def show_progress(arguments: argparse.Namespace) -> bool:
    """Whether to show progress on standard error: without ``--json``."""
    return not arguments.json
