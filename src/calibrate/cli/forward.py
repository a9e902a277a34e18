"""The choice of a forward map on the command line: ``--forward`` and the options of its kinds."""

from __future__ import annotations

import argparse

from emulator.surrogates.registry import FORWARD_MAPS, full_options, known_options


def add_forward(parser: argparse.ArgumentParser) -> None:
    """Add ``--forward`` and every option of every kind in the registry."""
    kinds = "; ".join(f"{kind.name}: {kind.help}" for kind in FORWARD_MAPS.values())
    parser.add_argument("--forward", choices=tuple(FORWARD_MAPS), default="emulator", help=kinds)
    for option, _ in known_options().values():
        text = f"{option.help} (default {option.default})"
        parser.add_argument(option.flag, type=int, metavar="N", help=text)


def forward_options(arguments: argparse.Namespace) -> dict[str, int]:
    """Options given on the command line; :class:`InputError` where the map takes no such option."""
    words = {name: getattr(arguments, name) for name in known_options()}
    given = {name: value for name, value in words.items() if value is not None}
    full_options(arguments.forward, given)
    return given
