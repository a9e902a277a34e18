"""Figures of a sensitivity study: indices of each observation, and maps of them on the body."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from calibrate.analysis.sensitivity import FIELD
from calibrate.figures.drawing import pyplot, save
from calibrate.figures.palette import BLUE, VERMILION
from emulator.geometry.facets import flat_triangles
from emulator.scenes.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FIRST, _TOTAL = BLUE, VERMILION
# By method: what a bar shows, and its label.
_BARS = {
    "sobol": (
        ("first_together", "first order", _FIRST),
        ("total_together", "total", _TOTAL),
    ),
    "morris": (("mu_star_together", "mean absolute effect", _FIRST),),
    "derivatives": (("bound_on_total_together", "bound on the total index", _TOTAL),),
}
_MAPPED = {"sobol": "total", "morris": "mu_star", "derivatives": "bound_on_total"}
_MOST_MAPS = 9  # more would be too small to see


def draw(found: xr.DataTree, scene: Scene, folder: str | Path) -> list[Path]:
    """Draw the indices, and maps where the field was analysed, into ``folder``; the files."""
    figures = {"sensitivity.png": index_figure(found)}
    if FIELD in found.children:
        figures["sensitivity_on_body.png"] = body_figure(found, scene)
    for name, figure in figures.items():
        save(figure, Path(folder) / name)
    return [Path(folder) / name for name in figures]


def index_figure(found: xr.DataTree) -> Any:
    """Bars of every factor, one panel for each observation, with 95 % intervals."""
    plt = pyplot()
    names, bars = list(found.children), _BARS[found.attrs["method"]]
    figure, panels = plt.subplots(
        1, len(names), figsize=(1.5 + 3.4 * len(names), 3.8), layout="constrained", squeeze=False
    )
    for axes, name in zip(panels[0], names, strict=True):
        _draw_bars(axes, found[name].to_dataset(), bars)
        title = name if name != FIELD else "displacement of all nodes"
        axes.set_title(f"{title}, sd {_sd(found[name].to_dataset())}", fontsize="medium")
    panels[0, 0].legend(frameon=False)
    figure.suptitle(f"{found.attrs['scene']} by {found.attrs['forward']}: what moves what")
    return figure


def _draw_bars(axes: Axes, data: xr.Dataset, bars: tuple[tuple[str, str, str], ...]) -> None:
    labels = [str(label) for label in data[bars[0][0]][data[bars[0][0]].dims[0]].values]
    y = np.arange(len(labels))
    for k, (name, label, colour) in enumerate(bars):
        width = data.get(f"{name}_half_width")
        axes.barh(
            y + 0.38 * (k - 0.5 * (len(bars) - 1)), data[name], 0.36, color=colour, label=label,
            xerr=None if width is None else width, error_kw={"lw": 0.8},
        )  # fmt: skip
    unit = data.attrs["unit"] if data.attrs["method"] == "morris" else "share of the variance"
    axes.set(yticks=y, yticklabels=labels, xlabel=unit)
    axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
    axes.invert_yaxis()
    axes.spines[["top", "right"]].set_visible(False)


def _sd(data: xr.Dataset) -> str:
    """Standard deviation over the prior, of one number or the root mean square of several."""
    if "variance" not in data:
        return "not estimated"
    unit = "" if data.attrs["unit"] == "1" else f" {data.attrs['unit']}"
    return f"{float(np.sqrt(data['variance'].mean())):.3g}{unit}"


def body_figure(found: xr.DataTree, scene: Scene) -> Any:
    """The body at rest, once for each factor, coloured by the factor's index at the nodes."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    plt = pyplot()
    name = _MAPPED[found.attrs["method"]]
    values = found[FIELD].to_dataset()[name]
    labels = [str(label) for label in values[values.dims[0]].values][:_MOST_MAPS]
    nodes, triangles = scene.mesh.nodes, flat_triangles(scene.mesh.surface)
    known = np.asarray(values)[:, triangles]
    # A node that is held does not vary; a facet takes the mean of the others, or is grey.
    counted = np.isfinite(known)
    total = np.where(counted, known, 0.0).sum(axis=-1)
    shades = np.where(counted.any(axis=-1), total / np.maximum(counted.sum(axis=-1), 1), np.nan)
    top = 1.0 if name == "total" else float(np.nanmax(shades))
    colours = plt.get_cmap("viridis").with_extremes(bad="0.8")
    colour = ScalarMappable(Normalize(0.0, top), colours)
    columns = min(len(labels), 5)
    rows = -(-len(labels) // columns)
    figure = plt.figure(figsize=(2.6 * columns + 1.2, 3.4 * rows), layout="constrained")
    panels = []
    for k, label in enumerate(labels):
        axes = figure.add_subplot(rows, columns, k + 1, projection="3d", azim=-60.0, elev=15.0)
        faces = colour.to_rgba(np.ma.masked_invalid(shades[k]))
        axes.add_collection3d(Poly3DCollection(nodes[triangles], facecolors=faces, lw=0.0))
        low, high = nodes.min(axis=0), nodes.max(axis=0)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(high - low, zoom=1.15)
        axes.set_axis_off()
        axes.set_title(label)
        panels.append(axes)
    said = {"total": "total index", "mu_star": "mean absolute effect (mm)"}
    label = said.get(name, "bound on the total index")
    figure.colorbar(colour, ax=panels, label=f"{label} of the displacement", shrink=0.8)
    return figure
