"""The figure of a beam's calibration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from calibrate.certificate import Certificate
from calibrate.figures.drawing import displacement_draws, displacement_part, pyplot, title_and_save
from calibrate.posterior import Posterior
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
    """The deformed body seen from the side, true and inferred, and the posterior of theta.

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
    """x-z view: reference and truth as lines, posterior mean as points coloured by its sd."""
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
    """Draws of the first two parameters, the truth, and the box the prior covers."""
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
