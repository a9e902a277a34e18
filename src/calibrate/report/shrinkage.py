"""The chart of a population's members: each alone, among the others, and one not seen."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from calibrate.figures.palette import BLUE, VERMILION
from calibrate.figures.shrinkage import APART, Intervals, intervals_of, label_of
from calibrate.population import Hierarchy
from calibrate.report.charts import translucent

_GREY = "#8c8c8c"
_COLUMNS = 3  # parameters beside each other, at most
_ROW, _MARGIN = 34, 110  # pixels: of a member, and around a row of parameters


def shrinkage(found: Hierarchy) -> go.Figure:
    """Medians and central 90 % intervals of each shared unknown, a row a member.

    Grey: by the member's own data. Blue: with the others. The band is a member not seen.
    """
    names, members = found.shared, found.members
    lines = math.ceil(len(names) / _COLUMNS)
    columns = math.ceil(len(names) / lines)  # four are two by two
    height = _ROW * len(members) + _MARGIN
    figure = make_subplots(
        lines, columns, shared_yaxes=True, horizontal_spacing=0.04,
        vertical_spacing=0.0 if lines == 1 else 0.8 * _MARGIN / (height * lines),
    )  # fmt: skip
    edges = (len(members) - 0.4, -0.6)  # the first member on top
    for k, name in enumerate(names):
        row, column = k // columns + 1, k % columns + 1
        for trace in _traces(intervals_of(found, name), members, edges):
            figure.add_trace(trace if k == 0 else trace.update(showlegend=False), row, column)
        figure.update_xaxes(title_text=label_of(found, name), row=row, col=column)
        ticks = {"tickvals": list(range(len(members))), "ticktext": members}
        figure.update_yaxes(range=edges, **ticks, automargin=True, row=row, col=column)
    legend = {"orientation": "h", "x": 0.0, "y": 1.02, "yanchor": "bottom"}
    figure.update_layout(height=lines * height, legend=legend)
    return figure


def _traces(
    intervals: Intervals, members: tuple[str, ...], edges: tuple[float, float]
) -> Iterator[go.Scatter]:
    """Band and median of a member not seen, then the intervals of all members."""
    low, middle, high = intervals.new
    yield go.Scatter(
        x=[low, high, high, low], y=[edges[0], edges[0], edges[1], edges[1]], fill="toself",
        fillcolor=translucent(VERMILION, 0.16), line_width=0, mode="lines", hoverinfo="skip",
        name="a member not seen, and its median", legendgroup="new",
    )  # fmt: skip
    yield go.Scatter(
        x=[middle, middle], y=edges, mode="lines", line={"color": VERMILION, "width": 1.5},
        hoverinfo="skip", showlegend=False, legendgroup="new",
    )  # fmt: skip
    rows = np.arange(len(members))
    yield _members(intervals.alone, rows - APART, members, _GREY, "alone")
    yield _members(intervals.together, rows + APART, members, BLUE, "with the others")


def _members(
    ends: np.ndarray, rows: np.ndarray, members: tuple[str, ...], colour: str, name: str
) -> go.Scatter:
    """A dot and a line for each of the intervals ``ends`` (3, n), at the heights ``rows`` (n,)."""
    low, middle, high = ends
    told = [f"{m}, {name}: {b:.4g} ({a:.4g} to {c:.4g})" for m, (a, b, c) in zip(
        members, ends.T, strict=True
    )]  # fmt: skip
    return go.Scatter(
        x=middle, y=rows, mode="markers", marker={"color": colour, "size": 7}, name=name,
        error_x={"type": "data", "symmetric": False, "array": high - middle,
                 "arrayminus": middle - low, "thickness": 2.5, "width": 0},
        text=told, hovertemplate="%{text}<extra></extra>", legendgroup=name,
    )  # fmt: skip
