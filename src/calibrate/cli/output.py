"""The output of commands: results as JSON or text, tables, posteriors, cavity volumes."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from emulator.core.errors import InputError
from emulator.core.store import to_json

if TYPE_CHECKING:
    import jax

    from calibrate.local_server import Server
    from emulator.accuracy.estimate import ErrorEstimate
    from emulator.scenes.scene import Scene

DONE, FAILED, BAD_INPUT = 0, 1, 2
"""Exit codes."""

_UNLIMITED = 1_000_000  # columns when the output is a file or a pipe


def emit(arguments: argparse.Namespace, result: Any, text: str) -> None:
    """Print ``result`` as JSON where ``--json`` asks for it, or ``text``."""
    print(to_json(result) if arguments.json else text)


def show_progress(arguments: argparse.Namespace) -> bool:
    """Return whether to show progress on standard error: yes without ``--json``."""
    return not arguments.json


@contextmanager
def needing_plotly(what: str) -> Iterator[None]:
    """Report a missing Plotly in one line that says that ``what`` it."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != "plotly":
            raise
        raise InputError(f"{what} plotly: pip install 'soft-tissue-calibrate[plot]'") from error


def serve_until_interrupted(
    arguments: argparse.Namespace, server: Server, result: Any, text: str, open_page: str = ""
) -> int:
    """Print where a server listens, open its page in a browser, and serve until Ctrl-C."""
    emit(arguments, result, text)
    sys.stdout.flush()
    if open_page:
        import webbrowser

        webbrowser.open(open_page)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        print("ended", file=sys.stderr)
    return DONE


def table(header: Sequence[str], rows: Iterable[Sequence[object]], width: int | None = None) -> str:
    """Return a table in text: the first column aligned to the left, the others to the right.

    Columns that do not fit ``width`` (by default the terminal's, if there is one) go below, with
    the first column again.
    """
    lines = [list(header), *([_cell(value) for value in row] for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]
    if width is None:
        width = shutil.get_terminal_size((_UNLIMITED, 24)).columns
    blocks = [
        "\n".join(_aligned(line, widths, columns) for line in lines)
        for columns in _blocks(widths, width)
    ]
    return "\n\n".join(blocks)


def _blocks(widths: Sequence[int], width: int) -> list[list[int]]:
    """Return the columns after the first that stand side by side, at least one in each block."""
    blocks: list[list[int]] = [[]]
    for k in range(1, len(widths)):
        together = [0, *blocks[-1], k]
        if blocks[-1] and sum(widths[j] + 2 for j in together) - 2 > width:
            blocks.append([])
        blocks[-1].append(k)
    return blocks


def _aligned(line: Sequence[str], widths: Sequence[int], columns: Sequence[int]) -> str:
    cells = [line[0].ljust(widths[0]), *(line[k].rjust(widths[k]) for k in columns)]
    return "  ".join(cells).rstrip()


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)


def posterior_summary(report: Mapping[str, Any]) -> str:
    """Return the parameter table and the verdict as text."""
    from calibrate.certificate.verdict import shifts

    parameters = report["parameters"]
    columns = ["mean", "sd", "low", "high", "r_hat", "ess_bulk"]
    titles = ["mean", "sd", "5 %", "95 %", "R-hat", "ESS"]
    if any("truth" in row for row in parameters.values()):
        columns, titles = ["truth", *columns], ["truth", *titles]
    shifts_by_judge = shifts(report.get("certificate", {}))
    rows = []
    for name, row in parameters.items():
        cells: list[object] = [row.get(column) for column in columns]
        rows.append((name, *cells, *(shift.get(name) for shift in shifts_by_judge.values())))
    lines = [table(("parameter", *titles, *(f"{judge}/sd" for judge in shifts_by_judge)), rows)]
    if shifts_by_judge:
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
        spread = "" if error is None else f" +- {error:.2g}"
        lines.append(f"log evidence {report['log_evidence']:.2f}{spread}")
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


Volumes = dict[str, dict[str, float | None]]


def volumes(scene: Scene, u: jax.Array, estimate: ErrorEstimate | None = None) -> Volumes:
    """Return each cavity's volume in mL at rest, at ``u`` (n, 3) mm, and its estimated error."""
    import jax

    from emulator.geometry.facets import Cavity
    from emulator.scenes.cavities import cavity_sets

    result: Volumes = {}
    for name in cavity_sets(scene):
        cavity = Cavity(scene.mesh, name)

        def volume(u: jax.Array, cavity: Cavity = cavity) -> jax.Array:
            return cavity(u[cavity.nodes])

        error = None if estimate is None or not estimate.valid else float(estimate.of(volume))
        loaded = float(jax.jit(volume)(u))
        result[name] = {"rest_ml": float(cavity.rest), "volume_ml": loaded, "error_ml": error}
    return result


def volume_lines(volumes_by_cavity: Volumes) -> list[str]:
    """Return a line for each cavity."""
    lines = []
    for name, cavity in volumes_by_cavity.items():
        error = "" if cavity["error_ml"] is None else f", error {cavity['error_ml']:+.2g} mL"
        rest, loaded = cavity["rest_ml"], cavity["volume_ml"]
        lines.append(f"cavity '{name}': {loaded:.6g} mL, at rest {rest:.6g} mL{error}")
    return lines
