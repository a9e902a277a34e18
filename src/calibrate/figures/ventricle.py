"""The figure of a ventricle's calibration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from calibrate.certificate import Certificate
from calibrate.figures.drawing import (
    displacement_draws,
    displacement_part,
    pyplot,
    title_and_save,
)
from calibrate.posterior import Posterior
from emulator.geometry.mesh import boundary_facets

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PRIOR, _POSTERIOR, _DATA = "0.75", "tab:blue", "tab:red"


def ventricle_figure(
    posterior: Posterior,
    truth: jax.Array,
    theta: Mapping[str, float],
    certificate: Certificate,
    path: str | Path,
) -> None:
    """The ventricle cut open with its landmarks, marginals, and the cavity's volume.

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
    """The half behind the long axis, at the posterior mean, coloured by its sd; landmarks."""
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
    """Posterior and prior density of a parameter over its box."""
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
    """Predicted cavity volume, prior and posterior, against the measured one."""
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
