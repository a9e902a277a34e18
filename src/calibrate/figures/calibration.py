"""The figure of a simulation-based calibration: how far ranks are from uniform."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibrate.figures.drawing import pyplot, save
from calibrate.figures.palette import BLUE, VERMILION
from calibrate.posterior.simulation_based import LEVELS, Calibration

_INSIDE, _OUTSIDE, _BAND = BLUE, VERMILION, "0.85"  # blue and vermilion differ for all readers


def draw(found: Calibration, title: str, path: str | Path) -> None:
    """Distribution function of each quantity's ranks less the uniform one, with its band.

    A hump above zero: truths lie low among the draws. Steep ends, flat middle: the posterior is too
    narrow. Flat ends, steep middle: it is too wide.
    """
    plt = pyplot()
    names, outside = list(found.ranks), found.outside()
    columns = min(len(names), 3)
    rows = -(-len(names) // columns)
    figure, grid = plt.subplots(
        rows, columns, figsize=(3.6 * columns, 2.9 * rows), layout="constrained", squeeze=False,
        sharex=True,
    )  # fmt: skip
    each = 1.0 - 0.05 / len(names)
    for axes, name in zip(grid.flat, names, strict=False):
        band = found.band(name, each)
        axes.fill_between(band.x, band.low - band.x, band.high - band.x, color=_BAND, lw=0)
        color = _OUTSIDE if outside[name] else _INSIDE
        axes.step(band.x, band.ecdf - band.x, where="post", color=color, lw=1.4)
        axes.axhline(0.0, color="0.4", lw=0.6)
        covered = found.coverage()[name]
        text = ", ".join(f"{100 * covered[c][0]:.0f}" for c in LEVELS)
        wanted = "/".join(f"{100 * c:g}" for c in LEVELS)
        axes.set_title(f"{name}\ncoverage {text} % ({wanted} %)", fontsize=9)
    for axes in grid.flat[len(names) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("rank of the truth among the draws")
    for axes in grid[:, 0]:
        axes.set_ylabel("distribution less uniform")
    verdict = "inside the 95 % band" if found.passed else "outside the 95 % band"
    figure.suptitle(f"{title}: {found.replicates} data sets, {verdict}")
    save(figure, path)


def draw_prior_predictive(
    data: dict[str, np.ndarray], units: dict[str, str], title: str, path: str | Path
) -> None:
    """Histogram of each observation over the prior; of its largest size, where it has many."""
    plt = pyplot()
    figure, grid = plt.subplots(
        1, len(data), figsize=(4.2 * len(data), 3.2), layout="constrained", squeeze=False
    )
    for axes, (name, values) in zip(grid.flat, data.items(), strict=True):
        several = values.ndim > 1
        sizes = (
            np.linalg.norm(values, axis=-1).reshape(len(values), -1).max(axis=1)
            if several
            else values
        )
        axes.hist(sizes, 30, color=_INSIDE, alpha=0.8)
        label = f"largest {name}" if several else name
        axes.set(xlabel=f"{label} ({units[name]})", yticks=[])
        low, high = np.quantile(sizes, [0.05, 0.95])
        axes.set_title(f"90 %: {low:.3g} to {high:.3g} {units[name]}", fontsize=9)
    figure.suptitle(title)
    save(figure, path)
