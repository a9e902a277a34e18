"""Parts of a study in processes of their own, which have compiled and factorised nothing before."""

import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import emulator as em

ROOT = Path(__file__).parents[2]


def command(module: str, *words: object) -> list[str]:
    """The words that run ``studies.MODULE``, e.g. of :func:`run`."""
    return [sys.executable, "-m", f"studies.{module}", *map(str, words)]


def environment(*, compiled: bool = True) -> dict[str, str]:
    """This process's, in which ``studies`` is found; without a cache of compiled programs if so."""
    found = {
        k: v for k, v in os.environ.items() if compiled or not k.startswith("JAX_COMPILATION_CACHE")
    }
    paths = [str(ROOT), *filter(None, [found.get("PYTHONPATH")])]
    return found | {"PYTHONPATH": os.pathsep.join(paths)}


def run(
    module: str, *words: object, compiled: bool = True, limit: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run ``studies.MODULE``; raises ``TimeoutExpired`` after ``limit`` seconds."""
    return subprocess.run(
        command(module, *words),
        capture_output=True,
        text=True,
        check=False,
        timeout=limit,
        env=environment(compiled=compiled),
    )


def printed(module: str, *words: object, compiled: bool = True) -> Any:
    """What ``studies.MODULE`` printed as its last line, JSON; ``SystemExit`` with its complaint."""
    done = run(module, *words, compiled=compiled)
    if done.returncode:
        raise SystemExit(f"studies.{module} {' '.join(map(str, words))}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def calibrate(folder: Path, *words: object) -> Any:
    """The answer of a command of ``calibrate`` in ``folder``."""
    program = str(Path(sys.executable).with_name("calibrate"))
    words = (program, *map(str, words), "--json")
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if not done.stdout.strip():
        raise em.SolverError(f"calibrate {' '.join(words[1:-1])}: {done.stderr.strip()[-500:]}")
    return json.loads(done.stdout)


def peak_gb() -> float:
    """Peak memory of this process.

    On Linux ``ru_maxrss`` begins at the value of the parent process; the kernel's high-water mark
    ``VmHWM`` starts afresh with the program.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(x for x in status.read_text().splitlines() if x.startswith("VmHWM"))
        kilobytes = int(line.split()[1])
    else:
        kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kilobytes * 1024 / 1e9
