"""The tables of the study's README."""

from typing import Any

Case = dict[str, Any]
SHORT = {"once_clamped_beam": "beam", "left_ventricle": "ventricle"}
ESTIMATES = ("error bar", "one step", "two steps", "centre tangent")


def named(case: Case) -> str:
    """Scene and map in short: the scene's own emulator is ``shipped``, its network ``network``."""
    scene, map_ = case["scene"], case["map"].removeprefix("shipped ").strip("'")
    own = {f"{scene}_series": "series", scene: "network", "ventricle_family": "family"}
    return f"{SHORT.get(scene, scene)}, {own.get(map_, map_)}"


def _mm(value: float | None) -> str:
    if value is None:
        return "not finite"
    return f"{value:.1f} mm" if value >= 1.0 else f"{value:.1e} mm"


def _times(cut: float | None) -> str:
    return "" if cut is None else f"{cut:.2g}"


def _effectivity(found: Case) -> str:
    low, _, high = (v if v is not None else float("nan") for v in found["of_max"])
    share = f"{100 * found['within_factor_2']:.0f} %"
    return f"{low:.2f}-{high:.2f}, {share}" if high < 1e6 else f"not finite, {share}"


def effectivities(cases: list[Case]) -> str:
    """Estimated over true largest error, least to most over theta, and the share that is good."""
    head = "scene, map, where | theta | err_u | error bar | one step | two steps | centre"
    lines = [f"| {head} | one step ok |", "|---" * 8 + "|"]
    for case in cases:
        cells = " | ".join(_effectivity(case["effectivity"][name]) for name in ESTIMATES)
        lines.append(
            f"| {named(case)}, {case['where']} | {case['theta']} | {_mm(case['err_u_mm'])} | "
            f"{cells} | {100 * case['one_step_was_enough']:.0f} % |"
        )
    return "\n".join(lines)


def polishes(cases: list[Case]) -> str:
    """Median errors inside the box after Newton steps, and the time to get there."""
    lines = [
        "| map, inside the box | 0 steps | 1 | 2 | converged | cut by 1 | by 2 |",
        "|---" * 7 + "|",
    ]
    for case in (case for case in cases if case["where"] == "inside"):
        mm, took = case["polish_mm"], {k: f"{1e3 * v:.0f} ms" for k, v in case["seconds"].items()}
        reached = {"1": "one step", "2": "two steps", "converged": "converged"}
        cells = " | ".join(f"{_mm(mm[k])}, {took[name]}" for k, name in reached.items())
        cuts = " | ".join(f"{_times(case['cut'][k][1])}" for k in ("1", "2"))
        lines.append(
            f"| {named(case)} (bar {took['error bar']}, centre {took['centre tangent']}) | "
            f"{_mm(mm['0'])} | {cells} | {cuts} |"
        )
    return "\n".join(lines)
