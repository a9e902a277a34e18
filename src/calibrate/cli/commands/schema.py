"""``calibrate schema``: the JSON Schema of scene files."""

from __future__ import annotations

import argparse
from typing import Any

from calibrate.cli.common import DONE, emit


def register(commands: Any) -> None:
    """Add the command."""
    commands.add_parser(
        "schema",
        help="JSON Schema of scene files, for editors",
        description="Prints the JSON Schema of scene files: their keys, kinds of laws, loads and "
        "supports, with units and descriptions. Editors complete and check a file that begins "
        "with the line '#:schema ./scene.schema.json'.",
        epilog="example: calibrate schema > scene.schema.json",
    )


def run(arguments: argparse.Namespace) -> int:
    """Print the schema, which is JSON with and without ``--json``."""
    from emulator.scenes.file_schema import scene_schema
    from emulator.store import to_json

    schema = scene_schema()
    emit(schema, as_json=arguments.json, text=to_json(schema))
    return DONE
