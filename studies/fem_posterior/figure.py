"""The study's figure: FEM solves an effective draw, and effective draws a second."""

from pathlib import Path
from typing import Any

from studies.common.output import save
from studies.fem_posterior.comparison import cost
from studies.fem_posterior.methods import CHEAP, PLAIN, TUNED

from calibrate.figures import BLUE, GREEN, ORANGE, VERMILION, pyplot

# Colours and shapes that differ for every reader (Okabe and Ito 2008).
MARKS = {
    PLAIN: (VERMILION, "X"),
    TUNED: (ORANGE, "^"),
    "delayed acceptance": (BLUE, "o"),  # recorded before this sampler was removed
    CHEAP: (GREEN, "s"),
}


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """A row a problem; filled marks as run, hollow ones without what a longer run would spread."""
    plt = pyplot()
    figure, panels = plt.subplots(
        1, 2, figsize=(11, 1.4 + 0.75 * len(cases)), layout="constrained", sharey=True
    )
    for place, case in enumerate(cases):
        for row, (method, (colour, mark)) in enumerate(MARKS.items()):
            for run in (run for run in case["runs"] if run["method"] == method):
                solves, y = cost(run), place + 0.15 * (row - 1.5)
                pairs = (
                    (solves["as run"], solves["of 1000"]),
                    (run["effective_per_s"], run["effective_per_s_again"]),
                )
                for axes, (filled, hollow) in zip(panels, pairs, strict=True):
                    if hollow is not None:
                        axes.plot([filled, hollow], [y, y], color=colour, lw=0.8)
                        axes.plot(hollow, y, mark, ms=7, mec=colour, mfc="white")
                    label = method if place == 0 else None
                    axes.plot(filled, y, mark, ms=7, color=colour, label=label, ls="")
    panels[0].set_yticks(range(len(cases)), [f"{c['name']}\n{c['nodes']} nodes" for c in cases])
    panels[0].set(xlabel="FEM solves an effective draw (hollow: of 1000 effective draws)")
    panels[1].set(xlabel="effective draws a second of processor time (hollow: compiled before)")
    panels[0].set_ylim(len(cases) - 0.5, -0.5)
    for axes in panels:
        axes.set_xscale("log")
        axes.grid(alpha=0.25)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    save(figure, path)
