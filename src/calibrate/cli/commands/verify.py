"""``calibrate verify``."""

from __future__ import annotations

import argparse
import sys
import time
from typing import TYPE_CHECKING, Any

from calibrate.cli.common import DONE, FAILED, emit, table
from emulator.core.errors import InputError

if TYPE_CHECKING:
    from emulator.verify import Benchmark

# Listed here too, so that --help needs no imports; a test compares them with verify.CASES.
CASE_NAMES = (
    "patch",
    "invariance",
    "derivatives",
    "barriers",
    "homogeneous",
    "sphere",
    "cook",
    "land_beam",
    "land_ventricle",
    "land_contraction",
)


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "verify",
        help="measured / reference / tolerance tables",
        description="Check the mechanics against closed forms, benchmarks and released solutions.",
        epilog=f"Cases: {', '.join(CASE_NAMES)} (all of them by default); or 'published DIR', FEM "
        "against the released FEniCS solutions in DIR.",
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases; 'published DIR'")


def run(arguments: argparse.Namespace) -> int:
    """Print the table; the exit code says whether every row is inside its tolerance."""
    rows = _rows(arguments.names)
    text = table(
        ("name", "measured", "reference", "tolerance", "passed"),
        [(r.name, r.measured, r.reference, r.tolerance, "yes" if r.passed else "NO") for r in rows],
    )
    failed = sum(not row.passed for row in rows)
    text += f"\n{len(rows)} rows, {failed or 'none'} outside the tolerance"
    emit([row.to_json() for row in rows], as_json=arguments.json, text=text)
    return FAILED if failed else DONE


def _rows(names: list[str]) -> list[Benchmark]:
    if names and names[0] == "published":
        if len(names) != 2:
            raise InputError("verify published: give the folder of the released data, and only it")
        from emulator.released.files import models_in
        from emulator.released.scenes import MODELS
        from emulator.verify import verify_published

        rows = verify_published(names[1])
        absent = sorted(set(MODELS) - set(models_in(names[1])))
        if absent:
            print(f"not in {names[1]}: {', '.join(absent)}", file=sys.stderr, flush=True)
        return rows
    for name in names:
        if name not in CASE_NAMES:
            raise InputError(
                f"verify: case '{name}' is unknown; known: {', '.join(CASE_NAMES)}, published DIR"
            )
    from emulator.verify import CASES

    rows = []
    for name in names or CASE_NAMES:
        begin = time.perf_counter()
        rows += CASES[name]()
        print(f"{name}: {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)
    return rows
