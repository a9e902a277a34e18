"""The figure of a hierarchy: each member alone and among the others, and the population."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calibrate.figures.drawing import BLUE, VERMILION, pyplot, save
from calibrate.population import Hierarchy
from calibrate.population.posterior import ALONE

_ALONE, _TOGETHER, _POPULATION = "0.55", BLUE, VERMILION
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
    unit = str(population.tree["posterior"][name].attrs.get("units", "1"))
    return name if unit == "1" else f"{name} ({unit})"


def draw(population: Hierarchy, path: str | Path, probability: float = 0.9) -> None:
    """Draw central intervals and medians of each shared unknown, one row for each member.

    Grey: the member's own data. Blue: with the population. The band is where a member not seen is
    expected, the line its median.
    """
    plt = pyplot()
    names, members = population.shared, population.members
    figure, grid = plt.subplots(
        1, len(names), figsize=(1.2 + 3.6 * len(names), 1.6 + 0.34 * len(members)), sharey=True,
        layout="constrained", squeeze=False,
    )  # fmt: skip
    rows = np.arange(len(members))
    for axes, name in zip(grid.flat, names, strict=True):
        alone, together, (low, middle, high) = intervals_of(population, name, probability)
        axes.axvspan(low, high, color=_POPULATION, alpha=0.14, lw=0, label="a member not seen")
        axes.axvline(middle, color=_POPULATION, lw=1.2)
        _intervals(axes, alone, rows - APART, _ALONE, "alone")
        _intervals(axes, together, rows + APART, _TOGETHER, "with the others")
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


def _intervals(axes: Any, ends: np.ndarray, rows: np.ndarray, color: str, label: str) -> None:
    """Draw a line and a dot for each of the intervals ``ends`` (3, n)."""
    low, middle, high = ends
    axes.hlines(rows, low, high, color=color, lw=2.2, label=label)
    axes.plot(middle, rows, "o", color=color, ms=4)
