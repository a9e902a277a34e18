"""What a study leaves: results.json, filled case by case and taken up again, and figures from it.

``content["cases"]`` has a ``name`` and a ``status`` each.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from calibrate.figures import pyplot
from calibrate.provenance import hardware, versions
from emulator.core.errors import InputError, SolverError
from emulator.core.store import replacing, write_json

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
    except (InputError, SolverError, OSError) as error:
        raise SystemExit(f"{Path(sys.argv[0]).parent.name}: {error}") from None


def commit(folder: str | Path) -> str | None:
    """Return the commit at ``folder``, with ``+`` if files were changed; ``None`` without git."""
    try:
        words = ["git", "-C", str(folder), "describe", "--always", "--dirty=+", "--abbrev=12"]
        process = subprocess.run(words, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return process.stdout.strip()


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
