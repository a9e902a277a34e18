"""``calibrate schema``: the JSON Schemas of scene and experiment files."""

from __future__ import annotations

import argparse
from typing import Any

from calibrate.cli.common import DONE, emit

_FILES = ("scene", "experiment")


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "schema",
        help="JSON Schema of scene or experiment files, for editors",
        description="Prints the JSON Schema of scene files: their keys, kinds of laws, loads and "
        "supports, with units and descriptions; or of experiment files: kinds of noise, systematic "
        "errors, forward maps and samplers. Editors complete and check a file that begins "
        "with the line '#:schema ./scene.schema.json'.",
        epilog="examples: calibrate schema > scene.schema.json; "
        "calibrate schema experiment > experiment.schema.json",
    )
    parser.add_argument(
        "file", nargs="?", choices=_FILES, default="scene", help="kind of file (default: scene)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Print the schema, which is JSON with and without ``--json``."""
    from emulator.core.store import to_json

    schema = _schema(arguments.file)
    emit(schema, as_json=arguments.json, text=to_json(schema))
    return DONE


def _schema(file: str) -> dict[str, Any]:
    if file == "scene":
        from emulator.scenes.file_schema import scene_schema

        return scene_schema()
    from calibrate.project.experiment_schema import experiment_schema

    return experiment_schema()
