"""Figures of a forward map's errors, after Figs. 5 to 13 of Dalton et al. (2023)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibrate.figures import draw_body, panels, pyplot, save, with_unit
from emulator.accuracy.comparison import UNITS, Errors, log_density, quantiles
from emulator.geometry.facets import flat_triangles
from emulator.geometry.mesh import Mesh
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene

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
_INSIDE, _OUTSIDE = "tab:blue", "tab:orange"


def draw(evaluated: Evaluated, folder: str | Path) -> list[Path]:
    """Draw all figures into ``folder``, and return the files."""
    scene, folder = evaluated.forward.scene, Path(folder)
    title = f"{scene.name}: {evaluated.forward.label} against {evaluated.report['reference']}"
    figures = {
        "error_densities.png": density_figure(evaluated.inside, evaluated.outside, title),
        "error_over_parameters.png": parameter_figure(
            scene, evaluated.inside, evaluated.outside, title
        ),
        "error_on_surface.png": surface_figure(
            scene.mesh, evaluated.inside.fields["err_u"].mean(axis=0), title
        ),
    }
    for name, figure in figures.items():
        save(figure, folder / name)
    return [folder / name for name in figures]


def density_figure(inside: Errors, outside: Errors | None, title: str) -> Any:
    """Return a figure of each error's density, its median and 97.5 % quantile; log axis."""
    names = [name for name in LABELS if name in inside.fields]
    figure, grid = panels(len(names), 3 if len(names) > 4 else 2, (4.2, 3.2))
    for axes, name in zip(grid.flat, names, strict=False):
        _draw_density(axes, inside.fields[name], _INSIDE, "inside" if outside else "")
        if outside is not None:
            _draw_density(axes, outside.fields[name], _OUTSIDE, "outside")
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


def _draw_density(axes: Axes, values: np.ndarray, colour: str, label: str) -> None:
    marks = quantiles(values)
    head = f"{label}: " if label else ""
    for name, style, text in (("median", "-", "median"), ("q97_5", "--", "97.5 %")):
        if marks[name] > 0.0:
            line = f"{head}{text} {marks[name]:.3g}"
            axes.axvline(marks[name], color=colour, ls=style, lw=1.2, label=line)
    curve = log_density(values)
    if curve is None:
        return  # all values are alike: no density to draw
    at, density = curve
    axes.plot(at, density, color=colour, lw=1.5)
    axes.fill_between(at, density, color=colour, alpha=0.2, lw=0)


def parameter_figure(scene: Scene, inside: Errors, outside: Errors | None, title: str) -> Any:
    """Return a figure of each case's median err_u: a map of two parameters, or panels of each."""
    groups = [(inside, "o", "inside the box")]
    if outside is not None:
        groups.append((outside, "D", "outside"))
    cases = [
        (errors.thetas, np.maximum(np.median(errors.fields["err_u"], axis=1), 1e-17), marker, label)
        for errors, marker, label in groups
    ]
    two = len(scene.parameters) == 2
    figure = _draw_map(scene, cases) if two else _draw_panels(scene, cases)
    figure.suptitle(title)
    return figure


def _draw_map(scene: Scene, cases: list[Any]) -> Any:
    """Draw cases in the plane of two parameters, coloured by their error."""
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Rectangle

    plt = pyplot()
    figure, axes = plt.subplots(figsize=(6.8, 5.4), layout="constrained")
    everything = np.concatenate([errors for _, errors, _, _ in cases])
    low, high = everything.min(), everything.max()
    norm = LogNorm(low, max(high, 1.01 * low))
    scatter = None
    for thetas, errors, marker, label in cases:
        scatter = axes.scatter(
            *thetas.T, c=errors, norm=norm, marker=marker, s=42, ec="k", lw=0.4, label=label
        )
    figure.colorbar(scatter, ax=axes, label="median error in displacement of a case (mm)")
    x, y = scene.parameters
    size = (x.high - x.low, y.high - y.low)
    axes.add_patch(Rectangle((x.low, y.low), *size, fill=False, ls="--", lw=1.0))
    if len(cases) > 1:
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
    axes.set(xlabel=with_unit(x.name, x.unit), ylabel=with_unit(y.name, y.unit))
    _scale(axes.set_xscale, axes.xaxis, x)
    _scale(axes.set_yscale, axes.yaxis, y)
    return figure


def _draw_panels(scene: Scene, cases: list[Any]) -> Any:
    """Draw the error of the cases over each parameter in turn."""
    figure, grid = panels(len(scene.parameters), 3, (3.8, 3.2), margin=(0.6, 0.6), sharey=True)
    for k, (axes, parameter) in enumerate(zip(grid.flat, scene.parameters, strict=False)):
        for (thetas, errors, marker, label), colour in zip(
            cases, (_INSIDE, _OUTSIDE), strict=False
        ):
            axes.scatter(
                thetas[:, k], errors, marker=marker, color=colour, s=22, alpha=0.75, lw=0,
                label=label,
            )  # fmt: skip
        axes.axvspan(parameter.low, parameter.high, color="0.93", zorder=0)
        axes.set(xlabel=with_unit(parameter.name, parameter.unit), yscale="log")
        _scale(axes.set_xscale, axes.xaxis, parameter)
    _plain(grid[0, 0].yaxis, (1.0, 2.0, 5.0))  # shared
    for axes in grid[:, 0]:
        axes.set_ylabel("median err_u of a case (mm)")
    if len(cases) > 1:
        figure.legend(
            *grid[0, 0].get_legend_handles_labels(),
            loc="outside lower center", ncols=2, frameon=False,
        )  # fmt: skip
    return figure


def _scale(set_scale: Any, axis: Any, parameter: Parameter) -> None:
    """Set the parameter's own scale, with plain numbers at its ticks."""
    if parameter.scale == "log":
        set_scale("log")
        _plain(axis, (1.0, 2.0, 3.0, 5.0, 7.0))


def _plain(axis: Any, digits: tuple[float, ...]) -> None:
    """Set ticks of a logarithmic axis at these leading digits, as plain numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis.set_major_locator(LogLocator(subs=digits))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


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
