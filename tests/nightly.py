"""Run every tier of the tests and write when, how long and how it ended to docs/testing.md.

``make nightly`` runs it; ``python tests/nightly.py lint fast`` runs the tiers that it names. A tier
is a row of the page's table: its name, its command, what it covers, and its last run whole.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from datetime import date
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "testing.md"
ENDED = re.compile(r"=*\s*((?:\d+ (?:failed|passed|skipped|errors?|deselected|warnings?)[, ]*)+)")


def tiers(page: str) -> dict[str, str]:
    """Return the command of each tier in the page's table, by the tier's name."""
    rows = re.findall(r"^\| ([^|]+) \| `([^`|]+)` \| [^|]+ \|[^|]*\|$", page, re.MULTILINE)
    return {name: command for name, command in rows if "<" not in command}


def outcome(code: int, output: str, seconds: float, day: date) -> str:
    """Return the cell of a tier that ended with ``code`` after printing ``output``."""
    counts = ENDED.findall(output)
    result = "; ".join(count.strip(" ,") for count in counts) or ("passed" if code == 0 else "")
    failed = "" if code == 0 else "FAILED, "
    return f"{day:%-d %B %Y}: {failed}{result + ', ' if result else ''}{seconds / 60:.0f} min"


def with_outcome(page: str, tier: str, cell: str) -> str:
    """Return the page with ``cell`` as the last one of the tier's row."""
    row = re.compile(rf"^(\| {re.escape(tier)} \| [^|]+ \| [^|]+ \|)[^|]*\|$", re.MULTILINE)
    return row.sub(lambda match: f"{match[1]} {cell} |", page, count=1)


def run(command: str) -> tuple[int, str]:
    """Run a tier's command, show what it prints, and return its exit code and output."""
    words = command.split()
    if words[0] == "calibrate":  # of this environment
        words[0] = str(Path(sys.executable).with_name("calibrate"))
    with subprocess.Popen(
        words, cwd=PAGE.parents[1], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        lines = []
        for line in process.stdout or ():
            print(line, end="", flush=True)
            lines.append(line)
    return process.returncode, "".join(lines)


def main(names: list[str]) -> int:
    """Run the tiers of these names, all without names; return 1 if one failed."""
    known = tiers(PAGE.read_text(encoding="utf-8"))
    if unknown := set(names) - known.keys():
        print(f"no tier {', '.join(sorted(unknown))}; there are {', '.join(known)}")
        return 2
    codes = []
    for name in names or known:
        start = time.perf_counter()
        code, output = run(known[name])
        codes.append(code)
        cell = outcome(code, output, time.perf_counter() - start, date.today())
        page = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(with_outcome(page, name, cell), encoding="utf-8")
        print(f"{name}: {cell}", flush=True)
    return int(any(codes))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
