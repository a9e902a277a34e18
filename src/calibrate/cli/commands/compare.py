"""``calibrate compare``."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.common import DONE, emit, table

if TYPE_CHECKING:
    from calibrate.posterior.comparison import Comparison


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "compare", help="which of several models predicts the same data better"
    )
    parser.add_argument("folders", metavar="DIR", nargs="+", help="of calibrate infer")


def run(arguments: argparse.Namespace) -> int:
    """Compare the posteriors in several folders."""
    from calibrate.posterior import read_tree
    from calibrate.posterior.comparison import compare
    from calibrate.project.workflow import POSTERIOR
    from emulator.core.errors import InputError

    if len(set(arguments.folders)) < len(arguments.folders):
        raise InputError("compare: a folder is given twice; give each model once")
    found = compare({folder: read_tree(Path(folder) / POSTERIOR) for folder in arguments.folders})
    report = {**asdict(found), "verdict": found.verdict}
    emit(report, as_json=arguments.json, text=summary(found))
    return DONE


def summary(found: Comparison) -> str:
    """Table and verdict as text."""
    header = ["model", "elpd", "less the best", "+-", "weight", "parameters"]
    evident = any(model.log_evidence is not None for model in found.models)
    rows = []
    for model in found.models:
        row: list[object] = [
            model.name, model.elpd, model.difference, model.difference_se, model.weight,
            model.parameters,
        ]  # fmt: skip
        if evident:
            row += [model.log_evidence, model.log_evidence_error]
        rows.append(row)
    lines = [table((*header, *(("log evidence", "+-") if evident else ())), rows)]
    lines.append(f"leave-one-out over {found.data} data: {found.verdict}")
    return "\n".join(lines)
