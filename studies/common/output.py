"""What a study leaves: results.json, filled case by case and taken up again, and figures from it.

``content["cases"]`` has a ``name`` and a ``status`` each.
"""

import argparse
import json
import math
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from studies.common.figures import pyplot

import emulator as em

PACKAGES = ("soft-tissue-calibrate", "jax", "jaxlib", "flax", "optax", "numpyro", "numpy", "scipy",
            "scikit-fem", "scikit-learn", "sparsax", "arviz")  # fmt: skip

Case = dict[str, Any]


def parser(doc: str | None, folder: Path) -> argparse.ArgumentParser:
    """The arguments that every study takes: ``--quick``, ``--again`` and ``--out``."""
    found = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("--quick", action="store_true", help="a few cases, within five minutes")
    found.add_argument("--again", action="store_true", help="repeat cases that results.json has")
    found.add_argument("--out", type=Path, default=folder)
    return found


def run(main: Callable[[], None]) -> None:
    """A study that reads what a user gives: what is wrong with it is told in one line."""
    try:
        main()
    except (em.InputError, em.SolverError, OSError) as error:
        raise SystemExit(f"{Path(sys.argv[0]).parent.name}: {error}") from None


def commit(folder: str | Path) -> str | None:
    """Return the commit at ``folder``, with ``+`` if files were changed; ``None`` without git."""
    try:
        words = ["git", "-C", str(folder), "describe", "--always", "--dirty=+", "--abbrev=12"]
        process = subprocess.run(words, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return process.stdout.strip()


def versions() -> dict[str, str]:
    """Return the versions of the packages that the numbers depend on."""
    return {name: version(name) for name in PACKAGES}


def hardware() -> dict[str, Any]:
    """Return processor, cores, and the accelerator if JAX uses one."""
    accelerator = None if jax.default_backend() == "cpu" else jax.devices()[0].device_kind
    cpuinfo, processor = Path("/proc/cpuinfo"), ""
    if cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        named = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
        processor = next(named, "")
    return {
        "processor": processor or platform.processor() or "unknown",
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "accelerator": accelerator,
    }


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary file next to ``path``, which it replaces if nothing raises."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _finite(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, np.ndarray):
        content = content.tolist()
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def write_json(path: Path, content: Any) -> None:
    """Write ``content``, whole or not at all; numbers that are not finite become null."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def table(header: list[str], rows: list[list[str]]) -> str:
    """Return lines of columns as wide as their widest cell, the first one to the left."""
    rows = [[str(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(w) if k == 0 else cell.rjust(w)
                  for k, (cell, w) in enumerate(zip(row, widths, strict=True))).rstrip()
        for row in (header, *rows)
    )  # fmt: skip


def study_header(folder: str | Path, seed: int) -> dict[str, Any]:
    """Return the first entries of every study's results.json."""
    return {"hardware": hardware(), "versions": versions(), "commit": commit(folder), "seed": seed}


class Results:
    """results.json under ``out``, written after each case; a case that is there is not repeated.

    again : begin with none. settings : of all cases, told in the file; results of other settings
    are not taken up again.
    """

    def __init__(
        self, out: Path, seed: int, *, again: bool = False, settings: Case | None = None
    ) -> None:
        out.mkdir(parents=True, exist_ok=True)
        self.path = out / "results.json"
        self._seed, self._settings = seed, settings or {}
        self.cases: list[Case] = []
        if self.path.is_file() and not again:
            there = json.loads(self.path.read_text())
            if there.get("settings", {}) == self._settings:
                self.cases = there["cases"]

    def case(self, name: str, make: Callable[[], Case]) -> Case:
        """The case of that name, made if it is not there. ``make`` may give its own status."""
        for case in self.cases:
            if case["name"] == name:
                return case
        found = {"name": name, "status": "done", **make()}
        self.cases.append(found)
        self.write()
        print(f"{name}: {found['status']}", flush=True)
        return found

    def write(self, **summary: Any) -> None:
        """Write all cases, and what they say together."""
        content = {**study_header(self.path.parent, self._seed), "settings": self._settings}
        write_json(self.path, content | {"cases": self.cases, **summary})


def save(figure: Any, path: Path, dpi: int = 130) -> None:
    """Write ``figure`` as PNG, whole or not at all, and close it."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi)
    pyplot().close(figure)
