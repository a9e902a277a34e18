"""Figures of a forward map's errors, after Figs. 5 to 13 of Dalton et al. (2023)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibrate.figures import draw_body, panels, pyplot, save
from emulator.accuracy.comparison import UNITS, Errors, log_density, quantiles
from emulator.geometry.facets import flat_triangles
from emulator.geometry.mesh import Mesh
from emulator.scenes.scene import with_mesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from calibrate.analysis.evaluation import Evaluated

LABELS = {
    "err_u": "error in displacement (mm)",
    "err_F": "error in deformation gradient",
    "err_I1": "error in first invariant",
    "err_E": "largest error in strain",
    "err_Pi": "error in energy (%)",
    "err_V": "error in cavity volume (%)",
    "err_R": "error in force of support (N)",
}
_COLOUR = "tab:blue"


def draw(evaluated: Evaluated, folder: str | Path) -> list[Path]:
    """Draw all figures into ``folder``, and return the files."""
    scene, folder = with_mesh(evaluated.forward.scene), Path(folder)
    title = f"{scene.name}: {evaluated.forward.label} against {evaluated.report['reference']}"
    figures = {
        "error_densities.png": density_figure(evaluated.errors, title),
        "error_on_surface.png": surface_figure(
            scene.mesh, evaluated.errors.fields["err_u"].mean(axis=0), title
        ),
    }
    for name, figure in figures.items():
        save(figure, folder / name)
    return [folder / name for name in figures]


def density_figure(errors: Errors, title: str) -> Any:
    """Return a figure of each error's density, its median and 97.5 % quantile; log axis."""
    names = [name for name in LABELS if name in errors.fields]
    figure, grid = panels(len(names), 3 if len(names) > 4 else 2, (4.2, 3.2))
    for axes, name in zip(grid.flat, names, strict=False):
        _draw_density(axes, errors.fields[name])
        axes.set(xscale="log", xlabel=LABELS[name], ylim=(0.0, None), yticks=[])
        if axes.lines:
            axes.legend(
                frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2
            )
        else:
            axes.text(0.5, 0.5, "no error", transform=axes.transAxes, ha="center")
        axes.spines[["top", "right", "left"]].set_visible(False)
    figure.suptitle(title)
    return figure


def _draw_density(axes: Axes, values: np.ndarray) -> None:
    marks = quantiles(values)
    for name, style, text in (("median", "-", "median"), ("q97_5", "--", "97.5 %")):
        if marks[name] > 0.0:
            line = f"{text} {marks[name]:.3g}"
            axes.axvline(marks[name], color=_COLOUR, ls=style, lw=1.2, label=line)
    curve = log_density(values)
    if curve is None:
        return  # all values are alike: no density to draw
    at, density = curve
    axes.plot(at, density, color=_COLOUR, lw=1.5)
    axes.fill_between(at, density, color=_COLOUR, alpha=0.2, lw=0)


def surface_figure(
    mesh: Mesh,
    values: np.ndarray,
    title: str,
    label: str = f"mean err_u of the cases ({UNITS['err_u']})",
) -> Any:
    """Return a figure of the surface at rest from two sides, coloured by nodal ``values`` (n,)."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator, NullFormatter

    nodes, triangles = mesh.nodes, flat_triangles(mesh.surface)
    shades = values[triangles].mean(axis=1)
    colour = ScalarMappable(Normalize(0.0, max(float(shades.max()), 1e-17)), "viridis")
    extent = np.ptp(nodes, axis=0)
    figure = pyplot().figure(figsize=(11.0, 5.2), layout="constrained")
    thin = extent < 0.25 * extent.max()
    sides = []
    for column, (azimuth, elevation) in enumerate(((-60.0, 15.0), (120.0, 40.0)), 1):
        axes = figure.add_subplot(1, 2, column, projection="3d", azim=azimuth, elev=elevation)
        draw_body(axes, nodes, triangles, 0.88, facecolors=colour.to_rgba(shades), lw=0.0)
        for k, name in enumerate("xyz"):
            axis = (axes.xaxis, axes.yaxis, axes.zaxis)[k]
            axis.set_major_locator(MaxNLocator(4))
            if thin[k]:  # tick labels would overlap
                axis.set_major_formatter(NullFormatter())
            else:
                getattr(axes, f"set_{name}label")(f"{name} (mm)", labelpad=14 if thin.any() else 4)
        sides.append(axes)
    figure.colorbar(colour, ax=sides, label=label, shrink=0.75)
    figure.suptitle(title)
    return figure
