"""The command line: ``calibrate <command>``.

Exit codes: 0 done, 1 ran but its result may not be used, 2 bad input with one clear line.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Sequence

from calibrate.cli import commands
from calibrate.cli.common import BAD_INPUT, FAILED, Parser
from calibrate.cli.compiled import VARIABLE, keep_programs
from emulator.errors import InputError, SolverError


def build_parser() -> Parser:
    """The parser with every command."""
    parser = Parser(prog="calibrate", description="Bayesian calibration of soft-tissue models.")
    parser.add_argument(
        "--no-cache",
        action="store_true",
        help="neither use nor keep compiled programs; otherwise they are in the user's cache "
        f"folder, or in {VARIABLE}",
    )
    chosen = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", parser_class=Parser
    )
    for module in pkgutil.iter_modules(commands.__path__):
        importlib.import_module(f"{commands.__name__}.{module.name}").register(chosen)
    return parser


def main(words: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        arguments = build_parser().parse_args(words)
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
