"""The figure of a hierarchy: each member alone and among the others, and the population."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from calibrate.figures import BLUE, VERMILION, panels, save, with_unit
from calibrate.population import Hierarchy
from calibrate.population.posterior import ALONE

APART = 0.16  # offset of a member's two intervals, in distances of rows


class Intervals(NamedTuple):
    """Low end, median and high end of central intervals of a shared unknown.

    alone, together : (3, n) of each member by its own data, and with the others. new : (3,) of a
    member not seen.
    """

    alone: np.ndarray
    together: np.ndarray
    new: np.ndarray


def intervals_of(population: Hierarchy, name: str, probability: float = 0.9) -> Intervals:
    """Return central intervals of ``probability`` of the shared unknown ``name``, in its unit."""
    together = np.moveaxis(np.asarray(population.tree["posterior"][name]), -1, 0)
    rows = together.reshape(len(population.members), -1)
    alone, new = np.asarray(population.tree[ALONE][name]), population.new_member()[name]
    edge = 0.5 * (1.0 - probability)
    ends = [edge, 0.5, 1.0 - edge]
    return Intervals(*(np.quantile(draws, ends, axis=-1) for draws in (alone, rows, new)))


def label_of(population: Hierarchy, name: str) -> str:
    """Return the label of a shared unknown: its name with its unit."""
    return with_unit(name, str(population.tree["posterior"][name].attrs.get("units", "1")))


def draw(population: Hierarchy, path: str | Path, probability: float = 0.9) -> None:
    """Draw central intervals and medians of each shared unknown, one row for each member.

    Grey: the member's own data. Blue: with the population. The band is where a member not seen is
    expected, the line its median.
    """
    names, members = population.shared, population.members
    size, margin = (3.6, 0.34 * len(members)), (1.2, 1.6)
    figure, grid = panels(len(names), len(names), size, margin, sharey=True)
    rows = np.arange(len(members))
    for axes, name in zip(grid.flat, names, strict=True):
        alone, together, (low, middle, high) = intervals_of(population, name, probability)
        axes.axvspan(low, high, color=VERMILION, alpha=0.14, lw=0, label="a member not seen")
        axes.axvline(middle, color=VERMILION, lw=1.2)
        for (start, median, end), at, colour, label in (
            (alone, rows - APART, "0.55", "alone"),
            (together, rows + APART, BLUE, "with the others"),
        ):
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
    save(figure, path)
