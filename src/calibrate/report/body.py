"""The body in three dimensions: draws of its shape, and what is known of it where."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import plotly.graph_objects as go

from calibrate.posterior import Posterior
from emulator.fem.fields import element_fields
from emulator.fem.solution import EquilibriumSolver
from emulator.geometry.facets import surface_mesh
from emulator.scenes.scene import Scene, with_mesh

_DRAWS = 20
_MOMENTS = 100  # draws from which mean and sd are computed
_FIBRES = 400  # largest number of fibres that are drawn
_DIGITS = 4
_SIGHT = np.array([1.45, 1.45, 0.9])  # from the body towards the eye
_WIDTH = 1.3  # of the picture, in its heights


def body_figure(posterior: Posterior, simulator: EquilibriumSolver | None) -> go.Figure:
    """Return the deformed surface with a slider over draws and a menu of colours.

    With several load states, the last is shown, and a button plays the mean shapes of all.

    simulator : FEM, which the map is compared with at the mean theta; None for no comparison.
    """
    model = posterior.model
    scene = with_mesh(model.forward.scene)
    thetas = posterior.thetas(model.states.states[-1])
    rows = np.linspace(0, len(thetas) - 1, min(_MOMENTS, len(thetas))).astype(int)
    centre = thetas.mean(axis=0)
    predict = jax.jit(lambda t: jax.lax.map(model.full, t))
    predicted = np.asarray(predict(jnp.vstack([thetas[rows], centre])))
    fields, at_centre = predicted[:-1], predicted[-1]  # (s, n, 3) and (n, 3)
    mean = fields.mean(axis=0)
    of_elements = element_fields(scene, jnp.asarray(mean), centre)
    colours = _colours(scene, fields, mean, of_elements)
    if simulator is not None and (solution := simulator.solve(centre)).converged:
        wrong = np.linalg.norm(at_centre - solution.displacement, axis=1)
        colours["error against FEM at the mean theta (mm)"] = wrong
    shown = fields[np.linspace(0, len(fields) - 1, min(_DRAWS, len(fields))).astype(int)]
    nodes, triangles = surface_mesh(scene.mesh.surface)
    i, j, k = triangles.T.tolist()
    first = next(iter(colours))
    figure = go.Figure(
        go.Mesh3d(
            **_xyz(scene.mesh.nodes[nodes] + mean[nodes]), i=i, j=j, k=k,
            **_coloured(colours[first][nodes], first), flatshading=True, name="deformed",
        )
    )  # fmt: skip
    figure.add_mesh3d(
        **_xyz(scene.mesh.nodes[nodes]), i=i, j=j, k=k, color="grey", opacity=0.12,
        name="as imaged" if scene.loaded_by else "at rest", showlegend=True, hoverinfo="skip",
    )  # fmt: skip
    if scene.fibres is not None:
        figure.add_trace(_fibres(scene, mean, of_elements["deformed_fibres"]))
    frames = {"mean": mean} | {f"draw {n}": u for n, u in enumerate(shown, start=1)}
    several = model.states.states if len(model.states.states) > 1 else ()
    states = {name: np.asarray(predict(posterior.thetas(name)[rows])).mean(0) for name in several}
    frames |= states
    at_rest = scene.mesh.nodes[nodes]
    figure.frames = [
        go.Frame(name=name, traces=[0], data=[go.Mesh3d(**_xyz(at_rest + u[nodes]))])
        for name, u in frames.items()
    ]
    _add_controls(figure, list(frames), {n: v[nodes] for n, v in colours.items()}, list(states))
    shapes = np.concatenate([at_rest, *(at_rest + u[nodes] for u in frames.values())])
    return figure.update_layout(scene_camera=_camera(np.ptp(shapes, axis=0)))


def _camera(extent: np.ndarray) -> dict[str, Any]:
    """Return Plotly's camera, as near as a box of this extent (3,) allows that is seen whole.

    Plotly scales the box to the volume 1; its eye sees 45 degrees from top to bottom.
    """
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * extent / np.cbrt(extent.prod())
    sight = _SIGHT / np.linalg.norm(_SIGHT)
    right = np.cross([0.0, 0.0, 1.0], sight) / np.hypot(*sight[:2])
    height = np.maximum(np.abs(corners @ np.cross(sight, right)), np.abs(corners @ right) / _WIDTH)
    eye = sight * (corners @ sight + height / np.tan(np.pi / 8.0)).max()
    return {
        "eye": dict(zip("xyz", eye.tolist(), strict=True)),
        "center": {"x": 0, "y": 0, "z": -0.1},
    }


def _colours(
    scene: Scene, fields: np.ndarray, mean: np.ndarray, of_elements: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return the values (n,) at the nodes by which the surface can be coloured, by their labels."""
    colours = {
        "mean displacement (mm)": np.linalg.norm(mean, axis=1),
        "sd of displacement (mm)": np.sqrt(fields.var(axis=0).sum(axis=1)),
    }
    largest = np.linalg.eigvalsh(of_elements["green_lagrange"])[:, -1]
    colours["largest principal strain"] = _nodal(scene, largest)
    if "fibre_stretch" in of_elements:
        colours["fibre stretch"] = _nodal(scene, of_elements["fibre_stretch"])
    return colours


def _nodal(scene: Scene, values: np.ndarray) -> np.ndarray:
    """Return the means (n,) at the nodes of element values (m,), weighted by volume."""
    elements, weights = scene.mesh.elements, scene.discretisation.weights.sum(axis=1)
    ends = np.broadcast_to(weights[:, None], elements.shape)
    total = np.bincount(elements.ravel(), (ends * values[:, None]).ravel())
    return total / np.bincount(elements.ravel(), ends.ravel())


def _xyz(points: np.ndarray) -> dict[str, list[float]]:
    return dict(zip("xyz", np.round(points.T, _DIGITS).tolist(), strict=True))


def _coloured(values: np.ndarray, title: str) -> dict[str, Any]:
    return {
        "intensity": np.array([f"{v:.4g}" for v in values], dtype=float).tolist(),
        "colorscale": "Viridis",
        "colorbar": {"title": {"text": title, "side": "right"}, "thickness": 14, "len": 0.8},
        "hovertemplate": "%{intensity:.4g}<extra></extra>",
    }


def _fibres(scene: Scene, mean: np.ndarray, directions: np.ndarray) -> go.Scatter3d:
    """Return short lines along the deformed fibres, ``directions`` (m, 3), of some elements."""
    some = np.linspace(0, len(directions) - 1, min(len(directions), _FIBRES)).astype(int)
    middle = (scene.mesh.nodes + mean)[scene.mesh.elements[some, :4]].mean(axis=1)
    half = 0.5 * np.cbrt(scene.discretisation.weights.sum(axis=1)[some])[:, None] * directions[some]
    ends = np.stack([middle - half, middle + half, np.full_like(middle, np.nan)], axis=1)
    lines = {name: [None if np.isnan(v) else round(float(v), _DIGITS) for v in ends[..., k].ravel()]
             for k, name in enumerate("xyz")}  # fmt: skip
    return go.Scatter3d(
        **lines, mode="lines", line={"color": "black", "width": 3}, name="fibres",
        visible="legendonly", hoverinfo="skip",
    )  # fmt: skip


def _add_controls(
    figure: go.Figure, names: list[str], colours: dict[str, np.ndarray], played: list[str]
) -> None:
    """Add a slider over the shapes, a menu of the colours, and a button that plays shapes."""
    at_once = {"mode": "immediate", "frame": {"duration": 0, "redraw": True},
               "transition": {"duration": 0}}  # fmt: skip
    steps = [{"label": n, "method": "animate", "args": [[n], at_once]} for n in names]
    buttons = []
    for title, values in colours.items():
        style = _coloured(values, title)
        restyle = {"intensity": [style["intensity"]], "colorbar.title.text": [title]}
        buttons.append({"label": title, "method": "restyle", "args": [restyle, [0]]})
    menus: list[dict[str, Any]] = [{"buttons": buttons, "x": 0.0, "xanchor": "left", "y": 1.12}]
    if played:
        pace = {"frame": {"duration": 700, "redraw": True}, "transition": {"duration": 0}}
        play = {"label": "play states", "method": "animate", "args": [played, pace]}
        menus += [{"type": "buttons", "buttons": [play], "x": 0.5, "xanchor": "left", "y": 1.12}]
    figure.update_layout(
        sliders=[{"steps": steps, "currentvalue": {"prefix": "shape: "}, "pad": {"t": 10}}],
        updatemenus=menus,
        scene={"aspectmode": "data", **{f"{a}axis": {"title": f"{a} (mm)"} for a in "xyz"}},
        height=680,
        legend={"x": 0.0, "y": 0.0},
    )
