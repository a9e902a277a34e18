"""The folder in which the command line keeps compiled programs for the next command.

Half of the time of a short command is compilation. JAX can write compiled programs to disk; the
command line has it do so, in the user's cache folder, with a bound on its size. As a library the
package configures nothing. ``JAX_COMPILATION_CACHE_DIR`` takes precedence where it is set.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

import jax

VARIABLE = "CALIBRATE_CACHE"
LARGEST = 1 << 30  # bytes; the least recently used programs are deleted first
_LEAST_SECONDS = 0.0  # every program is kept: compiling a hundred small ones takes 2 s


def keep_programs(environment: Mapping[str, str] = os.environ) -> Path | None:
    """Have JAX write compiled programs to disk; return their folder, or ``None`` for nowhere.

    ``CALIBRATE_CACHE`` names the folder; where it is empty, nothing is written. A folder that
    cannot be written to is reported, and the command runs without it.
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
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", LARGEST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _LEAST_SECONDS)
    return folder


def program_folder(environment: Mapping[str, str]) -> Path | None:
    """Return the folder for programs of this machine and this JAX; ``None`` for nowhere.

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
    return base / f"jax-{jax.__version__}-{_instructions()}"


def _instructions() -> str:
    """Return a short name of the processor's instruction set."""
    flags = ""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    digest = hashlib.sha256(f"{platform.processor()} {flags}".encode()).hexdigest()[:8]
    return f"{platform.machine()}-{digest}"
