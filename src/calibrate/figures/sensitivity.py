"""Figures of a sensitivity study and of simulation-based calibration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from calibrate.analysis.sbc import LEVELS, Calibration
from calibrate.analysis.sensitivity import FIELD
from calibrate.figures import BLUE, VERMILION, draw_body, panels, pyplot, save
from emulator.core.store import write_netcdf
from emulator.geometry.facets import flat_triangles
from emulator.geometry.io import write_vtu
from emulator.scenes.scene import Scene

_INSIDE, _OUTSIDE, _BAND = BLUE, VERMILION, "0.85"  # blue and vermilion differ for all readers


def calibration_figure(calibration: Calibration, title: str, path: str | Path) -> None:
    """Draw the difference of each quantity's distribution of ranks to the uniform one, and a band.

    A hump above zero: truths lie low among the draws. Steep ends, flat middle: the posterior is too
    narrow. Flat ends, steep middle: it is too wide.
    """
    names, outside = list(calibration.ranks), calibration.outside()
    figure, grid = panels(len(names), 3, (3.6, 2.9), sharex=True)
    probability = 1.0 - 0.05 / len(names)
    for axes, name in zip(grid.flat, names, strict=False):
        band = calibration.band(name, probability)
        axes.fill_between(band.x, band.low - band.x, band.high - band.x, color=_BAND, lw=0)
        color = _OUTSIDE if outside[name] else _INSIDE
        axes.step(band.x, band.ecdf - band.x, where="post", color=color, lw=1.4)
        axes.axhline(0.0, color="0.4", lw=0.6)
        covered = calibration.coverage()[name]
        text = ", ".join(f"{100 * covered[c][0]:.0f}" for c in LEVELS)
        wanted = "/".join(f"{100 * c:g}" for c in LEVELS)
        axes.set_title(f"{name}\ncoverage {text} % ({wanted} %)", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("rank of the truth among the draws")
    for axes in grid[:, 0]:
        axes.set_ylabel("distribution less uniform")
    verdict = "inside the 95 % band" if calibration.passed else "outside the 95 % band"
    figure.suptitle(f"{title}: {calibration.replicates} data sets, {verdict}")
    save(figure, path)


def draw_prior_predictive(
    data: dict[str, np.ndarray], units: dict[str, str], title: str, path: str | Path
) -> None:
    """Draw a histogram over the prior of each observation, or of its largest size."""
    figure, grid = panels(len(data), len(data), (4.2, 3.2))
    for axes, (name, values) in zip(grid.flat, data.items(), strict=True):
        sizes, label = values, name
        if values.ndim > 1:
            sizes = np.linalg.norm(values, axis=-1).reshape(len(values), -1).max(axis=1)
            label = f"largest {name}"
        axes.hist(sizes, 30, color=_INSIDE, alpha=0.8)
        axes.set(xlabel=f"{label} ({units[name]})", yticks=[])
        low, high = np.quantile(sizes, [0.05, 0.95])
        axes.set_title(f"90 %: {low:.3g} to {high:.3g} {units[name]}", fontsize=9)
    figure.suptitle(title)
    save(figure, path)


if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FIRST, _TOTAL = BLUE, VERMILION
# By method: what a bar shows, and its label.
_BARS = {
    "sobol": (("first_together", "first order", _FIRST), ("total_together", "total", _TOTAL)),
    "morris": (("mu_star_together", "mean absolute effect", _FIRST),),
    "derivatives": (("bound_on_total_together", "bound on the total index", _TOTAL),),
}
_MAPPED = {"sobol": "total", "morris": "mu_star", "derivatives": "bound_on_total"}
_MOST_MAPS = 9  # more would be too small to see


def draw(study: xr.DataTree, scene: Scene, folder: str | Path) -> list[Path]:
    """Draw the indices into ``folder``, with maps if the field was analysed; return the files."""
    figures = {"sensitivity.png": index_figure(study)}
    if FIELD in study.children:
        figures["sensitivity_on_body.png"] = body_figure(study, scene)
    for name, figure in figures.items():
        save(figure, Path(folder) / name)
    return [Path(folder) / name for name in figures]


def write(study: xr.DataTree, scene: Scene, folder: str | Path) -> None:
    """Write the indices as netCDF, their figures, and indices of the nodes as VTU."""
    write_netcdf(Path(folder) / "sensitivity.nc", study)
    draw(study, scene, folder)
    if FIELD in study.children:
        data = study[FIELD].to_dataset()
        nodal = {
            f"{name} {label}": np.nan_to_num(values)
            for name in ("first", "total", "mu_star", "bound_on_total")
            if name in data
            for label, values in zip(
                data[data[name].dims[0]].values, data[name].values, strict=True
            )
        }
        write_vtu(Path(folder) / "sensitivity.vtu", scene.mesh, point_data=nodal)


def index_figure(study: xr.DataTree) -> Any:
    """Return a figure of every factor's bars with 95 % intervals, a panel for each observation."""
    names, bars = list(study.children), _BARS[study.attrs["method"]]
    figure, grid = panels(len(names), len(names), (3.4, 3.8), margin=(1.5, 0.0))
    for axes, name in zip(grid[0], names, strict=True):
        _draw_bars(axes, study[name].to_dataset(), bars)
        title = name if name != FIELD else "displacement of all nodes"
        axes.set_title(f"{title}, sd {_sd(study[name].to_dataset())}", fontsize="medium")
    grid[0, 0].legend(frameon=False)
    figure.suptitle(f"{study.attrs['scene']} by {study.attrs['forward']}: what moves what")
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
    """Return the sd over the prior, of one number or the root mean square of several."""
    if "variance" not in data:
        return "not estimated"
    unit = "" if data.attrs["unit"] == "1" else f" {data.attrs['unit']}"
    return f"{float(np.sqrt(data['variance'].mean())):.3g}{unit}"


def body_figure(study: xr.DataTree, scene: Scene) -> Any:
    """Return a figure of the body at rest for each factor, coloured by its nodal index."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    plt = pyplot()
    name = _MAPPED[study.attrs["method"]]
    values = study[FIELD].to_dataset()[name]
    labels = [str(label) for label in values[values.dims[0]].values][:_MOST_MAPS]
    nodes, triangles = scene.mesh.nodes, flat_triangles(scene.mesh.surface)
    known = np.asarray(values)[:, triangles]
    # A fixed node has no index: a facet has the mean over its other nodes, or is grey.
    counted = np.isfinite(known)
    total = np.where(counted, known, 0.0).sum(axis=-1)
    shades = np.where(counted.any(axis=-1), total / np.maximum(counted.sum(axis=-1), 1), np.nan)
    top = 1.0 if name == "total" else float(np.nanmax(shades))
    colours = plt.get_cmap("viridis").with_extremes(bad="0.8")
    colour = ScalarMappable(Normalize(0.0, top), colours)
    columns = min(len(labels), 5)
    rows = -(-len(labels) // columns)
    figure = plt.figure(figsize=(2.6 * columns + 1.2, 3.4 * rows), layout="constrained")
    maps = []
    for k, label in enumerate(labels):
        axes = figure.add_subplot(rows, columns, k + 1, projection="3d", azim=-60.0, elev=15.0)
        faces = colour.to_rgba(np.ma.masked_invalid(shades[k]))
        draw_body(axes, nodes, triangles, 1.15, facecolors=faces, lw=0.0)
        axes.set_axis_off()
        axes.set_title(label)
        maps.append(axes)
    quantities = {"total": "total index", "mu_star": "mean absolute effect (mm)"}
    label = quantities.get(name, "bound on the total index")
    figure.colorbar(colour, ax=maps, label=f"{label} of the displacement", shrink=0.8)
    return figure
