"""The command line: ``calibrate <command>``.

Exit codes: 0 done, 1 ran but its result may not be used, 2 bad input with one clear line.

Commands only translate words into a call of the library and its result into text.
:data:`COMMANDS` is the list of them.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import jax

from calibrate.cli.words import Parser
from emulator import __version__
from emulator.core.errors import InputError, SolverError
from emulator.core.rooms import missing_room, offered
from emulator.core.store import to_json

DONE, FAILED, BAD_INPUT = 0, 1, 2
"""Exit codes."""

COMMANDS = {
    "campaign": "fem",
    "certify": "posteriors",
    "check": "check",
    "cohort": "cohort",
    "compare": "posteriors",
    "completion": "scene_files",
    "demo": "posteriors",
    "effects": "analyses",
    "evaluate": "evaluate",
    "explore": "serving",
    "export": "export",
    "frames": "frames",
    "identify": "analyses",
    "infer": "posteriors",
    "init": "scene_files",
    "mesh": "meshing",
    "predict": "prediction",
    "released": "train",
    "report": "posteriors",
    "scenes": "scene_files",
    "schema": "scene_files",
    "sensitivity": "analyses",
    "serve": "serving",
    "simulate": "fem",
    "terms": "analyses",
    "train": "train",
    "unload": "fem",
    "verify": "check",
}
"""The module of :mod:`calibrate.cli.commands` that has the command, by the command's name."""

_NO_CACHE = "--no-cache"
VARIABLE = "CALIBRATE_CACHE"
LARGEST = 1 << 30  # bytes; the least recently used programs are deleted first
_LEAST_SECONDS = 0.0  # every program is kept: compiling a hundred small ones takes 2 s


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
        for add in offered(f"calibrate.cli.commands.{COMMANDS[name]}", name):
            add(commands, name)
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
        answer = arguments.run(arguments)
        print(to_json(answer.result) if arguments.json else answer.text, flush=True)
        if answer.then is not None:
            answer.then()
        return DONE if answer.usable else FAILED
    except InputError as error:
        print(f"calibrate: {error}", file=sys.stderr)
        return BAD_INPUT
    except SolverError as error:
        print(f"calibrate: {error}", file=sys.stderr)
        return FAILED
    except ModuleNotFoundError as error:
        if (message := missing_room(error)) is None:
            raise
        print(f"calibrate: {message}", file=sys.stderr)
        return BAD_INPUT
    except OSError as error:
        what = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        print(f"calibrate: cannot read or write {what}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("calibrate: interrupted", file=sys.stderr)
        return FAILED


def keep_programs(environment: Mapping[str, str] = os.environ) -> Path | None:
    """Have JAX write compiled programs to disk; return their folder, or ``None`` for nowhere.

    Half of the time of a short command is compilation. As a library the package configures nothing,
    and ``JAX_COMPILATION_CACHE_DIR`` takes precedence where it is set. A folder that cannot be
    written to is reported, and the command runs without it.
    """
    if jax.config.jax_compilation_cache_dir is not None:
        return None
    folder = program_folder(environment)
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f".writable-{os.getpid()}").touch()
        (folder / f".writable-{os.getpid()}").unlink()
    except OSError as error:
        print(f"calibrate: compiled programs are not kept: {folder}: {error}", file=sys.stderr)
        return None
    _prune(folder)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _LEAST_SECONDS)
    return folder


def _prune(folder: Path) -> None:
    """Delete the files of ``folder`` that were used longest ago, where all exceed a gigabyte.

    JAX can bound the size itself, but then reads the time of every program for each one it writes:
    a first command would spend a third of its time on that.
    """
    files = []
    for path in folder.iterdir():
        with suppress(OSError):  # another command may have deleted it
            status = path.stat()
            files.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    excess = sum(size for _, size, _ in files) - LARGEST
    for _, size, path in sorted(files):
        if excess <= 0:
            break
        with suppress(OSError):
            path.unlink()
        excess -= size


def program_folder(environment: Mapping[str, str]) -> Path | None:
    """Return the folder for programs of this machine and this JAX; ``None`` for nowhere.

    ``CALIBRATE_CACHE`` names it; empty, there is none, and by default it is in the user's cache.
    Programs use the instructions of the processor they were compiled on, so that a home directory
    on several machines holds a folder for each kind.
    """
    folder_name = environment.get(VARIABLE)
    if folder_name == "":
        return None
    if folder_name is not None:
        base = Path(folder_name).expanduser()
    else:
        home = environment.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
        base = Path(home) / "calibrate"
    cpuinfo, flags = Path("/proc/cpuinfo"), ""
    if cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    digest = hashlib.sha256(f"{platform.processor()} {flags}".encode()).hexdigest()[:8]
    return base / f"jax-{jax.__version__}-{platform.machine()}-{digest}"
