"""The choice of a forward map on the command line: ``--forward`` and the options of its kinds."""

from __future__ import annotations

import argparse

from emulator.surrogates.registry import FORWARD_MAPS, full_options, known_options


def add_forward(parser: argparse.ArgumentParser, default: str | None = "emulator") -> None:
    """Add ``--forward`` and every option of every kind in the registry."""
    kinds = "; ".join(f"{kind.name}: {kind.help}" for kind in FORWARD_MAPS.values())
    parser.add_argument("--forward", choices=tuple(FORWARD_MAPS), default=default, help=kinds)
    for option, _ in known_options().values():
        text = f"{option.help} (default {option.default})"
        parser.add_argument(option.flag, type=int, metavar="N", help=text)


def given_options(arguments: argparse.Namespace) -> dict[str, int]:
    """Options of a forward map that were given on the command line."""
    words = {name: getattr(arguments, name) for name in known_options()}
    return {name: value for name, value in words.items() if value is not None}


def forward_options(arguments: argparse.Namespace) -> dict[str, int]:
    """:func:`given_options`; :class:`InputError` where the map takes no such option."""
    given = given_options(arguments)
    full_options(arguments.forward, given)
    return given
