"""What each way infers of each heart, beside the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from studies.common.figures import BLUE, ORANGE, VERMILION, pyplot
from studies.common.output import Case, save

COLOURS = {"unloaded": BLUE, "fibres known": ORANGE, "image at rest": VERMILION}
LABELS = {
    "stiffness": "fibre stress at 10 % stretch, kPa",
    "tension": "tension of systole, kPa",
    "pressure in the image": "pressure in the image, mmHg",
    "unloaded volume": "unloaded volume, mL",
    "endo": "endocardial angle, degrees",
    "epi": "epicardial angle, degrees",
}


def draw(cases: list[Case], told: Case, truth: dict[str, list[float]], path: Path) -> None:
    """A panel a quantity: 90 % intervals against the truth, a colour a way.

    told : of the study's summary. truth : (hearts,) by quantity.
    """
    figure, panels = pyplot().subplots(2, 3, figsize=(11.5, 7.2), layout="constrained")
    for axes, (name, label) in zip(panels.flat, LABELS.items(), strict=True):
        order = np.argsort(np.argsort(truth[name]))
        for k, (way, colour) in enumerate(COLOURS.items()):
            tried = [n for n, case in enumerate(cases) if way in case["ways"]]
            rows = [cases[n]["ways"][way]["intervals"].get(name) for n in tried]
            if not rows or None in rows or rows[0]["sd"] == 0.0:  # not asked, or known
                continue
            place = order[tried] + 0.24 * (k - 1)
            low, high = np.array([row["90"] for row in rows]).T
            inside = told[way][name]["inside"]
            text = f"{way}: {inside} of {len(rows)}"
            axes.vlines(place, low, high, color=colour, lw=2.2, label=text)
            axes.plot(place, [row["mean"] for row in rows], "o", color=colour, ms=3)
        low, high = order - 0.45, order + 0.45
        axes.hlines(truth[name], low, high, color="black", lw=1.0)
        axes.set(title=label, xticks=[], xlabel="hearts, by what is true (black)")
        axes.title.set_size(10)
        bottom, top = axes.get_ylim()
        axes.set_ylim(bottom, top + 0.3 * (top - bottom))
        axes.legend(frameon=False, fontsize=8, loc="upper left")
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle("From an image to a posterior: 90 % intervals")
    save(figure, path)
