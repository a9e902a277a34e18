"""The README's tables, as Markdown."""

from typing import Any

import numpy as np
from studies.fem_posterior.comparison import cost


def tables(cases: list[dict[str, Any]]) -> str:
    """Agreement by weights, agreement of runs, and costs; a row a problem or a run."""
    problems = [case for case in cases if "runs" in case]
    lines = ["| | shift | error | change of sd | error | verdict |", "|---|---|---|---|---|---|"]
    for case in problems:
        (shift, shift_error), (sd, sd_error) = case["largest_shift"], case["largest_log_sd"]
        lines.append(
            f"| {_title(case)} | {_small(shift)} sd | {_small(shift_error)} | "
            f"{_small(100.0 * sd)} % | {_small(100.0 * sd_error)} | {case['status']} |"
        )
    lines += ["", "| | runs | largest shift | largest change of an sd | largest z | rms z |"]
    lines += ["|---|---|---|---|---|---|"]
    for case in problems:
        for found in case["agreement"]:
            shift, sd = (max(map(abs, found[key].values())) for key in ("shift", "log_sd"))
            lines.append(
                f"| {case['name']} | {found['of']}, {found['against']} | {shift:.2f} sd | "
                f"{100.0 * sd:.0f} % | {found['largest_z']:.1f} | {found['rms_z']:.1f} |"
            )
    lines += ["", "| | | effective draws | R-hat | FEM solves | a draw | of 1000 | kept | s |"]
    lines[-1] += " again | a second | again |"
    lines += ["|---|---|---|---|---|---|---|---|---|---|---|---|"]
    for case in problems:
        for run in case["runs"]:
            again, rate = run["processor_again_s"], run["effective_per_s_again"]
            a_draw = cost(run)
            lines.append(
                f"| {case['name']} | {run['method']} | {run['effective']:.0f} | {run['r_hat']:.3f} "
                f"| {run['fem_solves']}{' + adjoints' if run['adjoints'] else ''} | "
                f"{a_draw['as run']:.2g} | {a_draw['of 1000']:.2g} | {a_draw['kept']:.2g} | "
                f"{run['processor_s']:.0f} | {'' if again is None else f'{again:.0f}'} | "
                f"{run['effective_per_s']:.2g} | {'' if rate is None else f'{rate:.2g}'} |"
            )
    for case in cases:
        lines += ["", *_shifts(case)] if "certificates" in case else []
    return "\n".join(lines)


def _shifts(case: dict[str, Any]) -> list[str]:
    """Terms of the certificates' shifts."""
    lines = [f"| {len(case['certificates'])} {case['name']} | rms | claimed | rms z | largest |"]
    lines[0] += " largest average |"
    lines += ["|---|---|---|---|---|---|"]
    for key, found in case["summary"].items():
        lines.append(
            f"| {key} | {found['rms']:.3f} | {found['claimed']:.3f} | {found['rms_z']:.2f} | "
            f"{found['largest']:.3f} | {np.abs(found['average']).max():.3f} |"
        )
    lines.append(f"error of the reference: {np.round(case['reference_error'], 3).tolist()}")
    return lines


def _title(case: dict[str, Any]) -> str:
    return f"{case['name']}, {case['nodes']} nodes, {len(case['names'])} unknowns"


def _small(value: float) -> str:
    return f"{value:.1e}" if value < 1e-3 else f"{value:.3f}"
