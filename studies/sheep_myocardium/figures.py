"""Pictures of the hearts: a mode predicted from the others, laws, the population."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from studies.common.figures import BLACK, BLUE, COLOURS, VERMILION, pyplot
from studies.common.output import Case, save
from studies.sheep_myocardium import cube
from studies.sheep_myocardium.experiment import MODES, Heart


def modes(hearts: Sequence[Heart], cases: Sequence[Case], out: Path) -> None:
    """Nine modes of every heart, each beside the 90 % band that the other eight predict."""
    plot = pyplot()
    drawn, axes = plot.subplots(
        len(hearts), 9, figsize=(17, 1.9 * len(hearts)), constrained_layout=True, squeeze=False
    )
    bands = {case["name"]: case.get("held_out_bands_N") for case in cases}
    for row, heart in zip(axes, hearts, strict=True):
        row[0].set_ylabel(f"{heart.name}\nforce, mN", fontsize=8)
        for axis, mode in zip(row, MODES, strict=True):
            curve = heart.curves[mode]
            low, middle, high = 1e3 * np.asarray(bands[heart.name][mode])
            axis.fill_between(curve.amount, low, high, color=BLUE, alpha=0.2, lw=0)
            axis.plot(curve.amount, middle, color=BLUE, lw=1)
            force = 1e3 * curve.force
            inside = (low <= force) & (force <= high)
            for some, colour in ((inside, BLACK), (~inside, VERMILION)):
                axis.plot(curve.amount[some], force[some], "o", color=colour, ms=3)
            axis.tick_params(labelsize=7)
    for axis, mode in zip(axes[0], MODES, strict=True):
        axis.set_title(mode, fontsize=9)
    drawn.suptitle("Each mode predicted from the other eight of its heart: median and 90 % band")
    save(drawn, out)


def overview(cases: Sequence[Case], out: Path) -> None:
    """Held-out modes by law, and medians of hearts alone and in their population."""
    hearts = [case for case in cases if "laws" in case]
    told = next(case for case in cases if case["name"] == "population")
    plot = pyplot()
    drawn, (left, right) = plot.subplots(1, 2, figsize=(12, 4.6), constrained_layout=True)
    laws = list(hearts[0]["laws"])
    for k, law in enumerate(laws):
        inside = [c["laws"][law]["held_out"]["inside_by_mode"] for c in hearts]
        points = hearts[0]["laws"][law]["held_out"]["points"] // len(MODES)
        share = [100 * np.mean([i[mode] for i in inside]) / points for mode in MODES]
        left.plot(range(len(MODES)), share, "o-", color=COLOURS[k % 7], label=law, lw=1)
    left.axhspan(80, 97, color="grey", alpha=0.15)
    left.set_xticks(range(len(MODES)), MODES)
    left.set_ylabel("points inside held-out 90 % bands, %")
    left.legend(frameon=False, fontsize=8)
    names = [n for n in told["names"] if n != "omega"]
    for k, case in enumerate(hearts):
        alone = case["laws"]["fibres, sheets, shear"]["parameters"]
        # Beyond the walls of the box parameters act as there.
        walls = zip(told["hearts"][case["name"]]["median"], cube.MATERIAL, strict=False)
        pooled = [np.clip(value, wall.low, wall.high) for value, wall in walls]
        for i, name in enumerate(names):
            x = i + 0.08 * (k - 3)
            right.plot([x, x], [alone[name]["median"], pooled[i]], color=COLOURS[k], lw=1)
            right.plot(x, alone[name]["median"], "o", mfc="none", color=COLOURS[k], ms=5)
            right.plot(
                x, pooled[i], "o", color=COLOURS[k], ms=5, label=case["name"] if not i else None
            )
    right.set_yscale("log")
    right.set_xticks(range(len(names)), names)
    right.set_ylabel("alone (open), in the population (full)")
    right.legend(frameon=False, fontsize=8, ncols=2)
    save(drawn, out)
