"""``calibrate verify``."""

from __future__ import annotations

import argparse
from typing import Any

from calibrate.cli.common import DONE, FAILED, add_json, emit, table


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser("verify", help="measured / reference / tolerance tables")
    parser.add_argument(
        "name", choices=("published",), help="published: FEM against released FEniCS solutions"
    )
    parser.add_argument("folder", metavar="DIR", help="folder of the released data")
    add_json(parser)
    parser.set_defaults(run=verify)


def verify(arguments: argparse.Namespace) -> int:
    """Print the table; the exit code says whether every row is inside its tolerance."""
    from calibrate.verify import verify_published

    rows = verify_published(arguments.folder)
    text = table(
        ("name", "measured", "reference", "tolerance", "passed"),
        [(r.name, r.measured, r.reference, r.tolerance, "yes" if r.passed else "NO") for r in rows],
    )
    emit([row.to_json() for row in rows], as_json=arguments.json, text=text)
    return DONE if all(row.passed for row in rows) else FAILED
