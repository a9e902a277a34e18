"""Tables and summary of the rows, and the README's claims."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from studies.few_runs.accuracy import OVER, PLAIN, RIVAL, SERIES

BUDGETS = (60, 180, 600, 1800)  # seconds
WANTED = 1e-2  # mm, median


def rows(cases: Iterable[dict], scene: str, method: str) -> list[dict]:
    """Rows of one method, fewest runs first."""
    found = [c for c in cases if (c.get("scene"), c.get("method")) == (scene, method)]
    return sorted(found, key=lambda case: case["runs"])


def scenes(cases: Iterable[dict]) -> list[str]:
    return list(dict.fromkeys(case["scene"] for case in cases if case["kind"] == "accuracy"))


def median(case: dict) -> float:
    return case["err_u_mm"]["median"]


def within(cases: list[dict], scene: str, methods: Iterable[str], budget: float) -> dict | None:
    """The row with the most runs within ``budget`` seconds of processor time."""
    paid = [
        case
        for method in methods
        for case in rows(cases, scene, method)
        if case["total_s"]["processor"] <= budget
    ]
    return max(paid, key=lambda case: case["runs"], default=None)


def rival_runs(cases: list[dict]) -> float | None:
    """FEM runs the rival needs for ``WANTED``, interpolated log-log between two rows."""
    found = rows(cases, "left_ventricle", RIVAL)
    if len(found) < 2:
        return None
    runs, errors = np.log([[case["runs"], median(case)] for case in found]).T
    k = int(np.clip(np.sum(errors > np.log(WANTED)), 1, len(runs) - 1))
    slope = (errors[k] - errors[k - 1]) / (runs[k] - runs[k - 1])
    return float(np.exp(runs[k - 1] + (np.log(WANTED) - errors[k - 1]) / slope))


def mesh_totals(cases: list[dict]) -> list[dict[str, Any]]:
    """Nodes and seconds until ``WANTED``: ours as measured, the rival's summed from its parts.

    The parts: compilation and the test runs; further runs up to the number it needs on the default
    mesh, each as long as ours with sensitivities, a tenth too long; and its fit on that mesh.
    """
    meshes = [case for case in cases if case["kind"] == "mesh"]
    needed = rival_runs(cases)
    fits = [c["fit_s"]["processor"] for c in rows(cases, "left_ventricle", RIVAL)]
    if not meshes or needed is None:
        return []
    runs = [case["runs"] for case in rows(cases, "left_ventricle", RIVAL)]
    fit = float(np.interp(needed, runs, fits))
    found = []
    for case in meshes:
        part = {k: v["processor"] for k, v in case.items() if k.endswith("_s")}
        rest = (needed - case["tests"]) * part["run_with_slopes_s"]
        found.append(
            {
                "nodes": case["nodes"],
                "run_s": part["run_with_slopes_s"],
                "ours_s": part["campaign_s"] + part["fit_s"],
                "ours_mm": median(case[OVER]),
                "rival_runs": needed,
                "rival_s": part["compile_fem_s"] + case["tests"] * part["run_s"] + rest + fit,
            }
        )
    return sorted(found, key=lambda row: row["nodes"])


def summary(cases: list[dict]) -> dict[str, Any]:
    """Ratios of medians by runs, and both methods at each budget."""
    found: dict[str, Any] = {}
    for scene in scenes(cases):
        rival = {case["runs"]: median(case) for case in rows(cases, scene, RIVAL)}
        found[scene] = {
            f"{method} / {RIVAL}": {
                str(case["runs"]): median(case) / rival[case["runs"]]
                for case in rows(cases, scene, method)
                if case["runs"] in rival
            }
            for method in (OVER, PLAIN)
        }
    return found | {"time to 1e-2 mm": mesh_totals(cases)}


def tables(cases: list[dict]) -> str:
    """The README's tables."""
    lines: list[str] = []
    for scene in scenes(cases):
        lines += ["", scene, *_by_method(cases, scene), "", *_by_runs(cases, scene)]
        for budget in BUDGETS:
            found = [within(cases, scene, m, budget) for m in ((SERIES, OVER), (PLAIN,), (RIVAL,))]
            cells = [
                "none" if c is None else f"{median(c):.1e} mm ({c['runs']} runs)" for c in found
            ]
            lines.append(f"| {scene} | {budget} s | " + " | ".join(cells) + " |")
    lines += ["", "time to the wanted error"]
    for row in mesh_totals(cases):
        lines.append(
            f"| {row['nodes']} | {row['run_s']:.2f} s | {row['ours_s']:.0f} s "
            f"({row['ours_mm']:.1e} mm) | {row['rival_s']:.0f} s |"
        )
    lines += ["", "nodes, tetrahedra, run, with slopes, series; medians after as many runs"]
    for case in (c for c in cases if c["kind"] == "mesh"):
        cells = [f"{case[k]['processor']:.2f}" for k in ("run_s", "run_with_slopes_s", "series_s")]
        cells += [f"{median(case[m]):.1e}" for m in ("series", OVER, PLAIN, RIVAL)]
        lines.append(f"| {case['nodes']} | {case['tetrahedra']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _by_method(cases: list[dict], scene: str) -> list[str]:
    """Every row of the four methods."""
    lines = ["| FEM runs | method | err_u median | mean | max | err_V median | FEM | fit | total |"]
    for case in sorted(
        (c for m in (SERIES, OVER, PLAIN, RIVAL) for c in rows(cases, scene, m)),
        key=lambda case: case["runs"],
    ):
        u, V = case["err_u_mm"], case["err_V_percent"]
        lines.append(
            f"| {case['runs']} | {case['method']} | {u['median']:.1e} mm | {u['mean']:.1e} mm | "
            f"{u['max']:.1e} mm | {V['median']:.1e} % | {case['campaign_s']['processor']:.0f} s | "
            f"{case['fit_s']['processor']:.1f} s | {case['total_s']['processor']:.0f} s |"
        )
    return lines


def _by_runs(cases: list[dict], scene: str) -> list[str]:
    """Median errors, a method a row and a number of runs a column."""
    own = [case for case in cases if case.get("scene") == scene]
    counts = sorted({case["runs"] for case in own})
    lines = ["| method | " + " | ".join(map(str, counts)) + " |"]
    for method in dict.fromkeys(case["method"] for case in own):
        found = {case["runs"]: f"{median(case):.1e}" for case in rows(cases, scene, method)}
        lines.append(f"| {method} | " + " | ".join(found.get(n, "") for n in counts) + " |")
    return lines


def check(cases: list[dict]) -> None:
    """The claims of the study's README."""
    for scene in scenes(cases):
        rival = {case["runs"]: median(case) for case in rows(cases, scene, RIVAL)}
        for case in rows(cases, scene, OVER):
            share = median(case) / rival[case["runs"]]
            assert share <= (1.0 / 3.0 if case["runs"] <= 30 else 1.0), case["name"]
