"""Tables of a posterior, or of a population, and verdicts as text."""

from __future__ import annotations

from typing import Any

from calibrate.cli.common import table


def summary(report: dict[str, Any]) -> str:
    """The parameter table and the verdict as text."""
    from calibrate.certificate.verdict import shifts

    parameters = report["parameters"]
    columns = ["mean", "sd", "low", "high", "r_hat", "ess_bulk"]
    titles = ["mean", "sd", "5 %", "95 %", "R-hat", "ESS"]
    if any("truth" in row for row in parameters.values()):
        columns, titles = ["truth", *columns], ["truth", *titles]
    moved = shifts(report.get("certificate", {}))
    rows = []
    for name, row in parameters.items():
        cells: list[object] = [row.get(column) for column in columns]
        rows.append((name, *cells, *(shift.get(name) for shift in moved.values())))
    lines = [table(("parameter", *titles, *(f"{what}/sd" for what in moved)), rows)]
    if moved:
        lines.append("FEM, mesh: how far FEM, and a finer mesh, would move each mean, in sd")
    lines.append(
        f"{report['chains']} chains x {report['draws']} draws, {report['divergences']} divergences"
        f", forward map: {report['forward']}"
    )
    for name, mass in report.get("prior_cut", {}).items():
        lines.append(f"prior of {name} cut to its range: {100.0 * mass:.2g} % of its mass")
    for name, count in report.get("missing", {}).items():
        lines.append(f"missing values of {name} left out: {count}")
    lines += report.get("warnings", [])
    if "log_evidence" in report:
        error = report["log_evidence_error"]
        known = "" if error is None else f" +- {error:.2g}"
        lines.append(f"log evidence {report['log_evidence']:.2f}{known}")
    if "fem_solves" in report:
        lines.append(
            f"FEM decided on every draw, in {report['fem_solves']} solves: no certificate is needed"
        )
    elif "certificate" not in report:
        lines.append("not checked against FEM yet: calibrate certify")
    else:
        c = report["certificate"]
        lines.append(
            f"verdict: {report['verdict']} (Pareto k {c['k_hat']:.2f}, "
            f"at most {c['k_threshold']:.2f}; {c['draws']} FEM runs, {c['failed']} failed): "
            f"{c['reason']}"
        )
        lines += [f"- {finding}" for finding in c["findings"] if finding != c["reason"]]
    return "\n".join(lines)


def cohort_summary(report: dict[str, Any]) -> str:
    """The population, its members alone and among the others, and one not seen."""
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
    for member, by in report["members"].items():
        cells = [by[n][k] for n in names for k in ("alone_mean", "alone_sd", "mean", "sd")]
        members.append((member, *cells, by["verdict"]))
    lines = [table(titles, rows), "", table((*head, "FEM says"), members), ""]
    for name, row in report["new_member"].items():
        lines.append(
            f"a member not seen: {name} {row['median']:.4g}, 90 % {row['low']:.4g} to "
            f"{row['high']:.4g}"
        )
    return "\n".join(lines + report["warnings"])
