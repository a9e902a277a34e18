"""``calibrate released``: a released network as an emulator."""

from __future__ import annotations

import argparse
from typing import Any

from calibrate.cli.common import DONE, emit


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "released",
        help="make an emulator of a network released with Dalton et al. (2023)",
        description="Read a released network and write it as an emulator, which evaluate, predict, "
        "infer and certify take like any other.",
    )
    parser.add_argument("model", metavar="MODEL", help="TwistingBeam, Liver or LeftVentricle")
    parser.add_argument(
        "--root", required=True, metavar="DIR", help="a clone of the release, or its folder data"
    )
    parser.add_argument("--out", required=True, metavar="DIR")


def run(arguments: argparse.Namespace) -> int:
    """Read, check and write the network."""
    from emulator.core.store import check_folder
    from emulator.surrogates import save_emulator
    from emulator.surrogates.released_network import released_network

    check_folder(arguments.out)
    emulator = released_network(arguments.model, arguments.root)
    save_emulator(emulator, arguments.out)
    result = {
        "scene": emulator.scene.name,
        "parameters": list(emulator.scene.parameter_names),
        "fingerprint": emulator.fingerprint,
        "out": arguments.out,
    }
    text = (
        f"{emulator.scene.name}: the released network, theta is "
        f"{', '.join(emulator.scene.parameter_names)}\nwritten: {arguments.out}"
    )
    emit(result, as_json=arguments.json, text=text)
    return DONE
