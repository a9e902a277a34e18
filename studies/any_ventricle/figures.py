"""Errors before any FEM run by kind of body, and against the number of bodies learned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from studies.common.figures import BLACK, BLUE, GREEN, VERMILION, pyplot
from studies.common.output import Case, save

KINDS = ("ellipsoid", "irregular", "coarser", "finer", "gmsh", "human")
WAYS = {
    "before": ("o", BLUE, "network, no FEM run"),
    "one_run": ("s", VERMILION, "series of one run"),
    "pod_gp": ("^", GREEN, "POD + GP of 20 runs"),
    "after": ("x", BLACK, "network, one run, six sweeps"),
}


def draw(cases: list[Case], path: Path) -> None:
    """A mark a body, and a line over the trainings of the curve, if they are there."""
    plt = pyplot()
    curve = sorted((c["bodies"], c["err_u_mm"]) for c in cases if "bodies" in c)
    count = 3 if curve else 2
    figure, panels = plt.subplots(1, count, figsize=(4.2 * count, 3.8), layout="constrained")
    rng = np.random.default_rng(0)
    swept = [c | c["sweeps"][-1] for c in cases if "sweeps" in c]
    rows = cases + [c | {"name": c["name"].removeprefix("sweeps, ")} for c in swept]
    for axes, key, unit in ((panels[0], "err_u", "mm"), (panels[1], "err_V", "%")):
        for way, (mark, colour, label) in WAYS.items():
            points = [
                (place + rng.uniform(-0.2, 0.2), case[way][key]["median"])
                for place, kind in enumerate(KINDS)
                for case in rows
                if case["name"].startswith(kind) and way in case
            ]
            if points:
                axes.plot(*zip(*points, strict=True), mark, color=colour, mfc="none", label=label)
        axes.set(yscale="log", ylabel=f"median {key}, {unit}")
        axes.set_xticks(range(len(KINDS)), KINDS, rotation=20)
        axes.grid(axis="y", color="0.9")
    panels[0].legend(frameon=False, fontsize=8)
    if curve:
        panels[2].plot(*zip(*curve, strict=True), "o-", color=BLUE)
        panels[2].set(xscale="log", yscale="log", xlabel="bodies learned", ylabel="err_u, mm")
        panels[2].set_xticks([n for n, _ in curve], [str(n) for n, _ in curve])
        panels[2].minorticks_off()
        panels[2].grid(color="0.9")
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, path)
