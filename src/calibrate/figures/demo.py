"""The figures of the two demonstrations: a beam's calibration and a ventricle's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from calibrate.certificate import Certificate
from calibrate.figures.drawing import displacement_draws, displacement_part, pyplot, title_and_save
from calibrate.posterior import Posterior
from emulator.geometry.mesh import boundary_facets
from emulator.surrogates.network.graph import mesh_edges

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def beam_figure(
    posterior: Posterior,
    truth: jax.Array,
    theta: Mapping[str, float],
    certificate: Certificate,
    path: str | Path,
) -> None:
    """Draw the deformed body from the side, true and inferred, and the posterior of theta.

    Parameters
    ----------
    truth : (n, 3) mm, the displacement the data was made from.
    theta : the true parameters by name.
    """
    plt = pyplot()
    fields = displacement_draws(posterior)
    figure, (side, joint) = plt.subplots(
        1, 2, figsize=(12.5, 4.8), width_ratios=(1.9, 1.0), layout="constrained"
    )
    scatter = _draw_side(side, posterior, np.asarray(truth), fields)
    figure.colorbar(scatter, ax=side, label="posterior sd of the position (mm)", shrink=0.85)
    _draw_joint(joint, posterior, theta)
    title_and_save(figure, posterior, certificate, path)


def _draw_side(axes: Axes, posterior: Posterior, truth: np.ndarray, fields: np.ndarray) -> Any:
    """Draw reference and truth as lines in x-z, the posterior mean as points coloured by sd."""
    from matplotlib.collections import LineCollection

    mesh = posterior.model.forward.scene.mesh
    face = mesh.nodes[:, 1] == mesh.nodes[:, 1].min()
    mean, sd = fields.mean(axis=0), np.sqrt(fields.var(axis=0, ddof=1).sum(axis=-1))
    edges = mesh_edges(mesh.elements)
    edges = edges[face[edges].all(axis=1)]
    for displacement, colour, label in (
        (np.zeros_like(truth), "0.8", "reference"),
        (truth, "black", "truth (FEM)"),
    ):
        ends = (mesh.nodes + displacement)[edges][:, :, [0, 2]]
        axes.add_collection(
            LineCollection(list(ends), colors=colour, lw=0.9, zorder=1, label=label)
        )
    place = mesh.nodes[face] + mean[face]
    scatter = axes.scatter(
        place[:, 0],
        place[:, 2],
        c=sd[face],
        cmap="viridis",
        s=26,
        zorder=3,
        label="posterior mean",
    )
    observe = displacement_part(posterior)
    data = observe.points + np.asarray(posterior.data["displacement"])
    axes.scatter(
        data[:, 0], data[:, 2], marker="x", c="tab:red", s=30, lw=1.2, zorder=4, label="data"
    )
    axes.set(xlabel="x (mm)", ylabel="z (mm)", aspect="equal")
    axes.legend(loc="lower left", frameon=False)
    return scatter


def _draw_joint(axes: Axes, posterior: Posterior, theta: Mapping[str, float]) -> None:
    """Draw the first two parameters' draws, the truth, and the box that the prior covers."""
    scene = posterior.model.forward.scene
    first, second = scene.parameters[:2]
    draws = posterior.draws()
    axes.scatter(
        draws[first.name], draws[second.name], s=4, alpha=0.25, lw=0, label="posterior draws"
    )
    axes.plot(theta[first.name], theta[second.name], "k+", ms=14, mew=2, label="truth")
    axes.set(
        xlabel=f"{first.name} ({first.unit})",
        ylabel=f"{second.name} ({second.unit})",
        xlim=(first.low, first.high),
        ylim=(second.low, second.high),
        title="prior box and posterior",
    )
    axes.legend(loc="upper right", frameon=False)


_PRIOR, _POSTERIOR, _DATA = "0.75", "tab:blue", "tab:red"


def ventricle_figure(
    posterior: Posterior,
    truth: jax.Array,
    theta: Mapping[str, float],
    certificate: Certificate,
    path: str | Path,
) -> None:
    """Draw the ventricle cut open with its landmarks, marginals, and the cavity's volume.

    Parameters
    ----------
    truth : (n, 3) mm, the displacement the data was made from.
    theta : the true parameters by name.
    """
    plt = pyplot()
    fields = displacement_draws(posterior)
    figure = plt.figure(figsize=(14.0, 6.6), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.35))
    _draw_body(left, posterior, fields)
    axes = right.subplots(2, 3)
    model = posterior.model
    prior = model.states.thetas(model.prior_draws(jax.random.key(1), 400))[:, 0]
    for panel, parameter in zip(axes.flat, posterior.model.forward.scene.parameters, strict=False):
        _draw_marginal(panel, posterior, parameter, theta[parameter.name])
    _draw_volume(axes.flat[-1], posterior, np.asarray(truth), prior)
    axes.flat[0].legend(loc="best", frameon=False, fontsize=8)
    title_and_save(figure, posterior, certificate, path)


def _draw_body(figure: Any, posterior: Posterior, fields: np.ndarray) -> None:
    """Draw the half behind the long axis, at the posterior mean, coloured by its sd; landmarks."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    mesh = posterior.model.forward.scene.mesh
    mean = mesh.nodes + fields.mean(axis=0)
    sd = np.sqrt(fields.var(axis=0, ddof=1).sum(axis=-1))
    middle = mesh.nodes[mesh.corners].mean(axis=1)
    facets = boundary_facets(mesh.elements[middle[:, 1] > 0.0])[:, :3]
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    body = Poly3DCollection(
        mean[facets], array=sd[facets].mean(axis=1), cmap="viridis", edgecolor="0.3", lw=0.15
    )
    axes.add_collection3d(body)
    observe = displacement_part(posterior)
    measured = observe.points + np.asarray(posterior.data["displacement"])
    moves = np.stack([observe.points, measured], axis=1)
    axes.add_collection3d(Line3DCollection(list(moves), colors=_DATA, lw=1.3, zorder=3))
    axes.scatter(*measured.T, c=_DATA, s=16, depthshade=False, zorder=4, label="landmarks, moved")
    axes.scatter(
        *observe.points.T, c="white", edgecolors=_DATA, s=16, depthshade=False, zorder=4,
        label="landmarks at rest",
    )  # fmt: skip
    low, high = mean.min(axis=0), mean.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.25)
    axes.view_init(elev=18.0, azim=-80.0)
    axes.set_axis_off()
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 0.0), frameon=False)
    axes.set_title("posterior mean, front half cut away")
    figure.colorbar(body, ax=axes, label="posterior sd of the position (mm)", shrink=0.6)


def _draw_marginal(axes: Axes, posterior: Posterior, parameter: Any, truth: float) -> None:
    """Draw posterior and prior density of a parameter over its box."""
    edges = np.linspace(parameter.low, parameter.high, 41).tolist()
    values = np.linspace(parameter.low, parameter.high, 200)[1:-1]
    density = np.exp(posterior.model.prior[parameter.name].log_prob(values))
    axes.fill_between(values, density, color=_PRIOR, lw=0, label="prior")
    draws = posterior.draws()[parameter.name]
    axes.hist(draws, edges, density=True, color=_POSTERIOR, alpha=0.75, label="posterior")
    for quantile in np.quantile(draws, [0.05, 0.95]):
        axes.axvline(quantile, color=_POSTERIOR, lw=1, ls=":")
    axes.axvline(truth, color="black", lw=1.6, label="truth")
    unit = f" ({parameter.unit})" if parameter.unit else ""
    axes.set(xlabel=f"{parameter.name}{unit}", yticks=[], xlim=(parameter.low, parameter.high))


def _draw_volume(axes: Axes, posterior: Posterior, truth: np.ndarray, prior: jax.Array) -> None:
    """Draw the predicted cavity volume, prior and posterior, against the measured one."""
    model = posterior.model
    volume = model.observe.parts["volume"]
    wall = model.full.at(volume.nodes)
    predict = jax.jit(lambda thetas: jax.lax.map(lambda theta: volume(wall(theta), theta), thetas))
    before, after = np.asarray(predict(prior)), np.asarray(predict(posterior.thetas()[::4]))
    measured, noise = float(posterior.data["volume"]), model.noise["volume"]
    axes.hist(after, 25, density=True, color=_POSTERIOR, alpha=0.75)
    for quantile in np.quantile(after, [0.05, 0.95]):
        axes.axvline(quantile, color=_POSTERIOR, lw=1, ls=":")
    axes.axvline(float(volume(truth[volume.nodes], prior[0])), color="black", lw=1.6)
    axes.axvline(measured, color=_DATA, lw=1.6, label="measured")
    if not noise.priors:
        sd = noise.upper_sd
        axes.axvspan(measured - sd, measured + sd, color=_DATA, alpha=0.2, lw=0, label="noise sd")
    low, high = np.quantile(before, [0.05, 0.95])
    axes.set(
        xlabel="predicted cavity volume (mL)",
        yticks=[],
        title=f"prior: {low:.0f} to {high:.0f} mL",
    )
    axes.margins(x=0.25, y=0.25)
    axes.legend(loc="upper center", ncols=2, frameon=False, fontsize=8)
