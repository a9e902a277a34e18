"""The figure of a hierarchy: each member alone and among the others, and the population."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibrate.figures.drawing import pyplot, save
from calibrate.figures.palette import BLUE, VERMILION
from calibrate.hierarchical_model import Hierarchy
from calibrate.hierarchical_model.tree import ALONE

_ALONE, _TOGETHER, _POPULATION = "0.55", BLUE, VERMILION
_APART = 0.16  # of the rows' distance, between a member's two intervals


def draw(found: Hierarchy, path: str | Path, probability: float = 0.9) -> None:
    """Central intervals of ``probability`` and medians of each shared unknown, a row a member.

    Grey: the member's own data. Blue: with the population. The band is where a member not seen is
    expected, the line its median.
    """
    plt = pyplot()
    names, members = found.shared, found.members
    figure, grid = plt.subplots(
        1, len(names), figsize=(1.2 + 3.6 * len(names), 1.6 + 0.34 * len(members)), sharey=True,
        layout="constrained", squeeze=False,
    )  # fmt: skip
    posterior, alone, rows = found.tree["posterior"], found.tree[ALONE], np.arange(len(members))
    new = found.new_member()
    for axes, name in zip(grid.flat, names, strict=True):
        low, middle, high = _interval(new[name][None], probability)[:, 0]
        axes.axvspan(low, high, color=_POPULATION, alpha=0.14, lw=0, label="a member not seen")
        axes.axvline(middle, color=_POPULATION, lw=1.2)
        together = np.moveaxis(np.asarray(posterior[name]), -1, 0).reshape(len(members), -1)
        _intervals(axes, np.asarray(alone[name]), rows - _APART, probability, _ALONE, "alone")
        _intervals(axes, together, rows + _APART, probability, _TOGETHER, "with the others")
        unit = str(posterior[name].attrs.get("units", "1"))
        axes.set_xlabel(name if unit == "1" else f"{name} ({unit})")
        axes.spines[["top", "right"]].set_visible(False)
    grid[0, 0].set_yticks(rows, members)
    grid[0, 0].invert_yaxis()
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=9,
        title=f"medians and central {100 * probability:g} % intervals", title_fontsize=9,
    )  # fmt: skip
    save(figure, path)


def _intervals(
    axes: Any, draws: np.ndarray, rows: np.ndarray, probability: float, color: str, label: str
) -> None:
    """A line and a dot for each row of ``draws`` (n, s)."""
    low, middle, high = _interval(draws, probability)
    axes.hlines(rows, low, high, color=color, lw=2.2, label=label)
    axes.plot(middle, rows, "o", color=color, ms=4)


def _interval(draws: np.ndarray, probability: float) -> np.ndarray:
    """Ends and middle (3, n) of the central interval of each row of ``draws`` (n, s)."""
    edge = 0.5 * (1.0 - probability)
    return np.quantile(draws, [edge, 0.5, 1.0 - edge], axis=1)
