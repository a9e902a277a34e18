"""The command line: ``calibrate <command>``.

Exit codes: 0 done, 1 ran but its result may not be used, 2 bad input with one clear line.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Sequence

from calibrate.cli import commands
from calibrate.cli.common import BAD_INPUT, FAILED, Parser, answer
from calibrate.cli.compiled import VARIABLE, keep_programs
from emulator import __version__
from emulator.core.errors import InputError, SolverError

_NO_CACHE = "--no-cache"


def build_parser(only: str | None = None) -> Parser:
    """The parser with every command, or with ``only`` one: the others' modules cost imports."""
    parser = Parser(prog="calibrate", description="Bayesian calibration of soft-tissue models.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument(
        _NO_CACHE,
        action="store_true",
        help="neither use nor keep compiled programs; otherwise they are in the user's cache "
        f"folder, or in {VARIABLE}",
    )
    chosen = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", parser_class=Parser
    )
    for name in command_names() if only is None else [only]:
        command = importlib.import_module(f"{commands.__name__}.{name}")
        command.register(chosen)
        if hasattr(command, "run"):  # those of several kinds answer each by itself
            answer(chosen.choices[name], command.run)
    return parser


def command_names() -> list[str]:
    """One command a module."""
    return [module.name for module in pkgutil.iter_modules(commands.__path__)]


def main(words: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        words = sys.argv[1:] if words is None else words
        first, known = next((word for word in words if word != _NO_CACHE), "-"), command_names()
        option = first.startswith("-")
        if not option and first not in known:
            raise InputError(f"'{first}' is no command; there are {', '.join(known)}")
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
