"""The command line: ``calibrate <command>``.

Exit codes: 0 done, 1 ran but its result may not be used, 2 bad input with one clear line.

Commands only translate words into a call of the library and print its result. :data:`COMMANDS` is
the list of them.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from calibrate.cli.compiled import VARIABLE, keep_programs
from calibrate.cli.output import BAD_INPUT, FAILED
from calibrate.cli.words import Parser
from emulator import __version__
from emulator.core.errors import InputError, SolverError

COMMANDS = {
    "campaign": "fem",
    "certify": "posteriors",
    "check": "check",
    "compare": "posteriors",
    "completion": "completion",
    "demo": "posteriors",
    "effects": "analyses",
    "evaluate": "emulators",
    "explore": "serving",
    "identify": "analyses",
    "infer": "posteriors",
    "init": "scene_files",
    "mesh": "scene_files",
    "predict": "emulators",
    "released": "train",
    "report": "posteriors",
    "scenes": "scene_files",
    "schema": "scene_files",
    "sensitivity": "sensitivity",
    "serve": "serving",
    "simulate": "fem",
    "train": "train",
    "unload": "fem",
    "verify": "check",
}
"""The module of :mod:`calibrate.cli.commands` that has ``add_<command>``, by command."""

_NO_CACHE = "--no-cache"


def build_parser(only: str | None = None) -> Parser:
    """Build the parser of every command, or with ``only`` one: the others' modules cost imports."""
    parser = Parser(prog="calibrate", description="Bayesian calibration of soft-tissue models.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument(
        _NO_CACHE,
        action="store_true",
        help="neither use nor keep compiled programs; otherwise they are in the user's cache "
        f"folder, or in {VARIABLE}",
    )
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", parser_class=Parser
    )
    for name in COMMANDS if only is None else [only]:
        module = importlib.import_module(f"calibrate.cli.commands.{COMMANDS[name]}")
        getattr(module, f"add_{name}")(commands)
    return parser


def main(words: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        words = sys.argv[1:] if words is None else words
        first = next((word for word in words if word != _NO_CACHE), "-")
        option = first.startswith("-")
        if not option and first not in COMMANDS:
            raise InputError(f"'{first}' is no command; there are {', '.join(COMMANDS)}")
        arguments = build_parser(None if option else first).parse_args(words)
        if not arguments.no_cache:
            keep_programs()
        return arguments.run(arguments)
    except InputError as error:
        print(f"calibrate: {error}", file=sys.stderr)
        return BAD_INPUT
    except SolverError as error:
        print(f"calibrate: {error}", file=sys.stderr)
        return FAILED
    except OSError as error:
        what = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        print(f"calibrate: cannot read or write {what}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("calibrate: interrupted", file=sys.stderr)
        return FAILED
