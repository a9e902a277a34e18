"""Pictures of the study's results."""

from pathlib import Path

import numpy as np
from studies.common.output import Case, save

from calibrate.figures import COLOURS, pyplot


def draw(cases: list[Case], path: Path) -> None:
    """How near the given mesh is met, and what it costs, by how far the body moves."""
    trips = [c for c in cases if c.get("kind") == "unload and load"]
    figure, (left, right) = pyplot().subplots(1, 2, figsize=(10, 4), layout="constrained")
    for colour, body in zip(COLOURS, dict.fromkeys(c["body"] for c in trips), strict=False):
        rows = [r for c in trips if c["body"] == body for r in c["rows"]]
        found = [r for r in rows if r["unloading"] == r["loading"] == "converged"]
        moved, missed = (np.array([r[k] for r in found]) for k in ("moved_mm", "missed_mm"))
        left.loglog(moved, np.maximum(missed, 1e-16), ".", color=colour, label=body)
        cost = [r["seconds"]["processor"] / r["cold_seconds"]["processor"] for r in found]
        right.plot(moved, cost, ".", color=colour)
    left.axhline(1e-8, color="0.6", lw=0.8)
    right.axhline(3.0, color="0.6", lw=0.8)
    left.set(
        xlabel="farthest move of a node, mm", ylabel="loaded again: distance from the mesh, mm"
    )
    right.set(xlabel="farthest move of a node, mm", ylabel="seconds of unloading / of a cold solve")
    left.legend(frameon=False, fontsize=8)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, path)
