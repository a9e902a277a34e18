"""Figures of results. Here is what they share: colours that every reader can tell apart, panels."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from emulator.core.errors import InputError
from emulator.core.store import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLUE = "#0072B2"
VERMILION = "#D55E00"
GREEN = "#009E73"
PINK = "#CC79A7"
ORANGE = "#E69F00"
SKY = "#56B4E9"
BLACK = "#000000"
COLOURS = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY, BLACK)


def pyplot() -> Any:
    """Return matplotlib.pyplot; :class:`InputError` when it is not installed.

    It draws to files, unless somebody imported it before and shows figures, as in a notebook.
    """
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise InputError(
            "figures need matplotlib: pip install 'soft-tissue-calibrate[plot]'"
        ) from error
    if "matplotlib.pyplot" not in sys.modules:
        mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def with_unit(name: str, unit: str) -> str:
    """Return a label: the name, and its unit in brackets if it has one."""
    return name if unit in ("", "1") else f"{name} ({unit})"


def panels(
    count: int,
    columns: int,
    size: tuple[float, float],
    margin: tuple[float, float] = (0.0, 0.0),
    **options: Any,
) -> tuple[Any, Any]:
    """Return a figure and the axes (rows, columns) of ``count`` panels of a size in inches."""
    columns = min(count, columns)
    rows = -(-count // columns)
    figure, grid = pyplot().subplots(
        rows, columns, figsize=(size[0] * columns + margin[0], size[1] * rows + margin[1]),
        layout="constrained", squeeze=False, **options,
    )  # fmt: skip
    for axes in grid.flat[count:]:
        axes.set_axis_off()
    return figure, grid


def draw_body(
    axes: Any, nodes: np.ndarray, triangles: np.ndarray, zoom: float, **style: Any
) -> Any:
    """Draw triangles between nodes (n, 3) mm in axes as large as the body; return the drawing."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    body = axes.add_collection3d(Poly3DCollection(nodes[triangles], **style))
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=zoom)
    return body


def save(figure: Figure, path: str | Path) -> None:
    """Write the figure, whole or not at all, and close it."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=140)
    pyplot().close(figure)
