"""What the rows amount to: tables, summary, and the README's claims."""

from collections.abc import Iterable
from typing import Any

from accuracy import OVER, PLAIN, RIVAL, SERIES

BUDGETS = (60, 180, 600)  # seconds
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
    """The row with the most runs that ``budget`` seconds pay for."""
    paid = [
        case
        for method in methods
        for case in rows(cases, scene, method)
        if case["total_s"]["processor"] <= budget
    ]
    return max(paid, key=lambda case: case["runs"], default=None)


def first_below(cases: list[dict], scene: str, methods: Iterable[str]) -> dict | None:
    """The quickest row whose median error is at most the wanted one."""
    good = [c for m in methods for c in rows(cases, scene, m) if median(c) <= WANTED]
    return min(good, key=lambda case: case["total_s"]["processor"], default=None)


def mesh_totals(cases: list[dict]) -> list[dict[str, Any]]:
    """Nodes and seconds until ``WANTED``: ours as measured, the rival's from its parts.

    The rival is given as many runs as it needed on the default mesh, each as quick as one started
    by the series, and the fit it needed there.
    """
    rival = first_below(cases, "left_ventricle", [RIVAL])
    ours = first_below(cases, "left_ventricle", [SERIES, OVER, PLAIN])
    if rival is None or ours is None:
        return []
    found = [
        {
            "nodes": ours["nodes"],
            "ours_s": ours["total_s"]["processor"],
            "rival_s": rival["total_s"]["processor"],
            "ours_mm": median(ours),
            "run_s": rows(cases, "left_ventricle", SERIES)[0]["test_run_s"]["processor"],
        }
    ]
    for case in (c for c in cases if c["kind"] == "mesh"):
        compiled, run = case["compile_fem_s"]["processor"], case["run_s"]["processor"]
        found.append(
            {
                "nodes": case["nodes"],
                "ours_s": case["campaign_s"]["processor"] + case["fit_s"]["processor"],
                "rival_s": compiled + rival["runs"] * run + rival["fit_s"]["processor"],
                "ours_mm": median(case[OVER]),
                "run_s": run,
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
        lines += ["", scene, "", "| FEM runs | method | err_u median | mean | max | err_V median "]
        lines[-1] += "| FEM | fit | total |"
        lines += ["|---|---|---|---|---|---|---|---|---|"]
        order = {SERIES: 0, OVER: 1, PLAIN: 2, RIVAL: 3}
        own = [c for c in cases if c.get("scene") == scene]
        for case in sorted(own, key=lambda c: (c["runs"], order.get(c["method"], 9))):
            u, V = case["err_u_mm"], case["err_V_percent"]
            lines.append(
                f"| {case['runs']} | {case['method']} | {u['median']:.1e} mm | {u['mean']:.1e} | "
                f"{u['max']:.1e} | {V['median']:.1e} % | {case['campaign_s']['processor']:.0f} s | "
                f"{case['fit_s']['processor']:.1f} s | {case['total_s']['processor']:.0f} s |"
            )
        for budget in BUDGETS:
            found = [within(cases, scene, m, budget) for m in ((SERIES, OVER), (PLAIN,), (RIVAL,))]
            shown = [
                "none" if c is None else f"{median(c):.1e} mm ({c['runs']} runs)" for c in found
            ]
            lines.append(f"budget | {budget} s | " + " | ".join(shown) + " |")
    for row in mesh_totals(cases):
        lines.append(
            f"| {row['nodes']} | {row['run_s']:.2f} s | {row['ours_s']:.0f} s "
            f"({row['ours_mm']:.1e} mm) | {row['rival_s']:.0f} s |"
        )
    for case in (c for c in cases if c["kind"] == "mesh"):
        cells = [f"{case[k]['processor']:.2f}" for k in ("run_s", "run_with_slopes_s", "series_s")]
        cells += [f"{median(case[m]):.1e}" for m in (SERIES_KEY, OVER, PLAIN, RIVAL)]
        lines.append(f"mesh | {case['nodes']} | {case['tetrahedra']} | " + " | ".join(cells))
    return "\n".join(lines)


SERIES_KEY = "series"


def check(cases: list[dict]) -> None:
    """The claims of the study's README."""
    for scene in scenes(cases):
        rival = {case["runs"]: median(case) for case in rows(cases, scene, RIVAL)}
        for case in rows(cases, scene, OVER):
            share = median(case) / rival[case["runs"]]
            assert share <= (1.0 / 3.0 if case["runs"] <= 30 else 1.0), case["name"]
