"""Results of commands as text: tables, posteriors, cavity volumes."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

from emulator.core.errors import InputError

_NAMED = 4  # points that a line names
_UNLIMITED = 1_000_000  # columns when the output is a file or a pipe


def check_plotly(what: str) -> None:
    """Raise InputError for ``what``, which needs Plotly, where Plotly is missing."""
    if find_spec("plotly") is None:
        raise InputError(f"{what} needs plotly: pip install 'soft-tissue-calibrate[plot]'")


def table(header: Sequence[str], rows: Iterable[Sequence[object]], width: int | None = None) -> str:
    """Return a table in text: the first column aligned to the left, the others to the right.

    Columns that do not fit ``width`` (by default the terminal's, if there is one) go below, with
    the first column again.
    """
    columns = list(zip(header, *(map(_cell, row) for row in rows), strict=True))
    widths = [max(map(len, column)) for column in columns]
    if width is None:
        width = shutil.get_terminal_size((_UNLIMITED, 24)).columns
    first, taken = [cell.ljust(widths[0]) for cell in columns[0]], widths[0]
    blocks = [[first]]
    for column, column_width in zip(columns[1:], widths[1:], strict=True):
        if len(blocks[-1]) > 1 and taken + 2 + column_width > width:
            blocks.append([first])
            taken = widths[0]
        blocks[-1].append([cell.rjust(column_width) for cell in column])
        taken += 2 + column_width
    return "\n\n".join(
        "\n".join("  ".join(line).rstrip() for line in zip(*block, strict=True)) for block in blocks
    )


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)


def posterior_summary(report: Mapping[str, Any]) -> str:
    """Return the parameter table and the verdict as text."""
    from calibrate.certificate.verdict import shifts
    from calibrate.priors.population import in_words

    parameters = report["parameters"]
    columns = ["mean", "sd", "low", "high", "r_hat", "ess_bulk"]
    titles = ["mean", "sd", "5 %", "95 %", "R-hat", "ESS"]
    if any("truth" in row for row in parameters.values()):
        columns, titles = ["truth", *columns], ["truth", *titles]
    of_prior = any("of_prior" in row for row in parameters.values())
    if of_prior:
        columns, titles = [*columns, "of_prior", "move"], [*titles, "of prior", "if wider"]
    shifts_by_judge = shifts(report.get("certificate", {}))
    rows = []
    for name, row in parameters.items():
        cells: list[object] = [row.get(column) for column in columns]
        rows.append((name, *cells, *(shift.get(name) for shift in shifts_by_judge.values())))
    lines = [table(("parameter", *titles, *(f"{judge}/sd" for judge in shifts_by_judge)), rows)]
    if of_prior:
        lines.append(
            "of prior: log sd over the prior's; if wider: how far a prior of twice the log sd "
            "would move the mean, in sd"
        )
    if shifts_by_judge:
        finer = "FEM between the grips" if "grips" in shifts_by_judge else "a finer mesh"
        finer += ", in steps half as long" if "mesh and steps" in shifts_by_judge else ""
        judges = ", ".join(shifts_by_judge)
        lines.append(f"{judges}: how far FEM, and {finer}, would move each mean, in sd")
    lines += in_words(report.get("priors", {}))
    lines.append(
        f"{report['chains']} chains x {report['draws']} draws, {report['divergences']} divergences"
        f", forward map: {report['map']}"
    )
    for last in report.get("rounds", [])[-1:]:
        lines.append(
            f"map: {last['runs']} FEM runs where the posterior is, in {len(report['rounds'])} "
            f"rounds; log likelihoods of the last were foreseen to {last['missed']:.2g}"
        )
    for name, mass in report.get("prior_cut", {}).items():
        lines.append(f"prior of {name} cut to its range: {100.0 * mass:.2g} % of its mass")
    lines += [missing_in_words(*places) for places in report.get("missing", {}).items()]
    lines += report.get("warnings", [])
    if "log_evidence" in report:
        error = report["log_evidence_error"]
        spread = "" if error is None else f" +- {error:.2g}"
        lines.append(f"log evidence {report['log_evidence']:.2f}{spread}")
    if "certificate" not in report:
        lines.append("not checked against FEM yet: calibrate certify")
    else:
        from calibrate.certificate.verdict import NO_TAIL

        c = report["certificate"]
        basis = f"{c['draws']} FEM runs, {c['failed']} failed"
        has_tail = c.get("tail", {}).get("largest", math.inf) >= NO_TAIL  # else k is of no tail
        if has_tail and c["k_hat"] is not None and math.isfinite(c["k_hat"]):
            basis = f"Pareto k {c['k_hat']:.2f}, at most {c['k_threshold']:.2f}; {basis}"
        lines.append(f"verdict: {report['verdict']} ({basis}): {c['reason']}")
        lines += [f"- {finding}" for finding in c["findings"] if finding != c["reason"]]
    return "\n".join(lines)


def missing_in_words(name: str, places: Sequence[str]) -> str:
    """Return how many points of an observation are missing, and where the first of them are."""
    more = ", ..." if len(places) > _NAMED else ""
    at = ", ".join(places[:_NAMED])
    return f"points of {name} without a value, left out: {len(places)} ({at}{more})"


def members_summary(report: Mapping[str, Any]) -> str:
    """Return the population, its members alone and together, and a member not seen as text."""
    columns = ("mean", "sd", "low", "high", "r_hat", "ess_bulk")
    titles = ("population", "mean", "sd", "5 %", "95 %", "R-hat", "ESS")
    rows = [
        (name, *(row[column] for column in columns))
        for name, row in report["population"].items()
        if name.startswith(("median[", "sd[", "correlation["))
    ]
    names = list(report["new_member"])
    head = ["member"]
    for name in names:
        head += [f"{name} alone", "sd", "with the others", "sd"]
    members = []
    for member, entry in report["members"].items():
        cells = [entry[n][k] for n in names for k in ("alone_mean", "alone_sd", "mean", "sd")]
        members.append((member, *cells, entry["verdict"]))
    lines = [table(titles, rows), "", table((*head, "FEM says"), members), ""]
    for name, row in report["new_member"].items():
        lines.append(
            f"a member not seen: {name} {row['median']:.4g}, 90 % {row['low']:.4g} to "
            f"{row['high']:.4g}"
        )
    return "\n".join(lines + report["warnings"])


def volume_lines(volumes: Mapping[str, Mapping[str, float | None]]) -> list[str]:
    """Return a line for each cavity."""
    lines = []
    for name, cavity in volumes.items():
        error = "" if cavity["error_ml"] is None else f", error {cavity['error_ml']:+.2g} mL"
        rest, loaded = cavity["rest_ml"], cavity["volume_ml"]
        lines.append(f"cavity '{name}': {loaded:.6g} mL, at rest {rest:.6g} mL{error}")
    return lines
