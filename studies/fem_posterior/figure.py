"""The study's figure: agreement and cost."""

from pathlib import Path
from typing import Any

from methods import CHEAP, LATE, PLAIN, TUNED

from calibrate.figures.drawing import pyplot
from emulator.store import replacing

# Okabe and Ito (2008).
COLOURS = {PLAIN: "#D55E00", TUNED: "#E69F00", LATE: "#0072B2", CHEAP: "#009E73"}


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Solves an effective draw and effective draws a second, a group of bars a problem."""
    plt = pyplot()
    figure, panels = plt.subplots(1, 2, figsize=(11, 3.8), layout="constrained")
    for axes, key, label in (
        (panels[0], "solves_per_effective_draw", "FEM solves an effective draw, warm-up included"),
        (panels[1], "effective_per_s", "effective draws a second of processor time"),
    ):
        for row, (method, colour) in enumerate(COLOURS.items()):
            found = [
                (place + 0.2 * (row - 1.5), run[key])
                for place, case in enumerate(cases)
                for run in case["runs"]
                if run["method"] == method
            ]
            if found:
                axes.barh(*zip(*found, strict=True), height=0.18, color=colour, label=method)
        axes.set_yticks(range(len(cases)), [f"{c['name']}\n{c['nodes']} nodes" for c in cases])
        axes.set(xscale="log", xlabel=label)
        axes.invert_yaxis()
        axes.grid(alpha=0.25, axis="x")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=130)
    plt.close(figure)
