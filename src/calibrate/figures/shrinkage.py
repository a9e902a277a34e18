"""The figure of a hierarchy: each member alone and among the others, and the population."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibrate.figures import BLUE, VERMILION, panels, save, with_unit
from calibrate.population import Hierarchy
from calibrate.population.posterior import ALONE

_APART = 0.16  # offset of a member's two intervals, in distances of rows
_COLUMNS = 3  # parameters beside each other, at most


def label_of(population: Hierarchy, name: str) -> str:
    """Return the label of a shared unknown: its name with its unit."""
    return with_unit(name, str(population.tree["posterior"][name].attrs.get("units", "1")))


def figure_of(population: Hierarchy, probability: float = 0.9) -> Any:
    """Return a figure of medians and central intervals of each shared unknown, a row a member.

    Grey: the member's own data. Blue: with the population. The band is where a member not seen is
    expected, the line its median.
    """
    names, members, new = population.shared, population.members, population.new_member()
    size, margin = (3.6, 0.34 * len(members) + 0.6), (1.2, 1.0)
    figure, grid = panels(len(names), _COLUMNS, size, margin, sharey=True)
    rows = np.arange(len(members))
    edge = 0.5 * (1.0 - probability)
    ends = [edge, 0.5, 1.0 - edge]
    for axes, name in zip(grid.flat, names, strict=False):
        low, middle, high = np.quantile(new[name], ends)
        axes.axvspan(low, high, color=VERMILION, alpha=0.14, lw=0, label="a member not seen")
        axes.axvline(middle, color=VERMILION, lw=1.2)
        together = np.moveaxis(np.asarray(population.tree["posterior"][name]), -1, 0)
        for draws, at, colour, label in (
            (np.asarray(population.tree[ALONE][name]), rows - _APART, "0.55", "alone"),
            (together.reshape(len(members), -1), rows + _APART, BLUE, "with the others"),
        ):
            start, median, end = np.quantile(draws, ends, axis=-1)
            axes.hlines(at, start, end, color=colour, lw=2.2, label=label)
            axes.plot(median, at, "o", color=colour, ms=4)
        axes.set_xlabel(label_of(population, name))
        axes.spines[["top", "right"]].set_visible(False)
    grid[0, 0].set_yticks(rows, members)
    grid[0, 0].invert_yaxis()
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=9,
        title=f"medians and central {100 * probability:g} % intervals", title_fontsize=9,
    )  # fmt: skip
    return figure


def draw(population: Hierarchy, path: str | Path, probability: float = 0.9) -> None:
    """Write :func:`figure_of` a population."""
    save(figure_of(population, probability), path)
