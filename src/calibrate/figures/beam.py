"""The picture of the beam's demo."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import jax
import numpy as np

from calibrate.certificate import Certificate
from calibrate.figures import pyplot, save, with_unit
from calibrate.measurements import DISPLACEMENT
from calibrate.measurements.points import DisplacementPoints
from calibrate.posterior import Posterior
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import with_mesh
from emulator.surrogates.network.graph import mesh_edges

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def drawing() -> Callable[..., None]:
    """Return :func:`draw`; :class:`InputError` without a plotting package."""
    pyplot()
    return draw


def draw(
    posterior: Posterior,
    certificate: Certificate,
    truth: jax.Array,
    theta: Mapping[str, float],
    path: Path,
) -> None:
    """Draw the body from the side, true and inferred, and the posterior of theta in its box.

    Reference and truth are lines in x-z, the posterior's mean is points coloured by its sd.

    Parameters
    ----------
    posterior, certificate : the posterior of the beam, and what FEM says of it.
    truth : the displacement (n, 3) mm that the data was made of.
    theta : the parameters of the truth, by name.
    path : the file of the picture.
    """
    from matplotlib.collections import LineCollection

    forward, scene = posterior.model.full, posterior.model.forward.scene
    thetas = np.asarray(posterior.thetas())
    rows = np.linspace(0, len(thetas) - 1, 200).astype(int)
    fields = np.asarray(jax.jit(lambda t: jax.lax.map(forward, t))(thetas[rows]))
    points = cast(DisplacementPoints, posterior.model.observe.parts[DISPLACEMENT]).points
    measured = points + np.asarray(posterior.data[DISPLACEMENT])
    mesh = with_mesh(scene).mesh
    figure, (side, joint) = pyplot().subplots(
        1, 2, figsize=(12.5, 4.8), width_ratios=(1.9, 1.0), layout="constrained"
    )
    face = mesh.nodes[:, 1] == mesh.nodes[:, 1].min()
    mean, sd = fields.mean(axis=0), np.sqrt(fields.var(axis=0, ddof=1).sum(axis=-1))
    edges = mesh_edges(mesh.elements)
    edges = edges[face[edges].all(axis=1)]
    for u, colour, label in ((0.0 * truth, "0.8", "reference"), (truth, "black", "truth (FEM)")):
        ends = (mesh.nodes + u)[edges][:, :, [0, 2]]
        lines = LineCollection(list(ends), colors=colour, lw=0.9, zorder=1, label=label)
        side.add_collection(lines)
    x, _, z = (mesh.nodes[face] + mean[face]).T
    shades = side.scatter(x, z, c=sd[face], cmap="viridis", s=26, zorder=3, label="posterior mean")
    x, _, z = measured.T
    side.scatter(x, z, marker="x", c="tab:red", s=30, lw=1.2, zorder=4, label="data")
    side.set(xlabel="x (mm)", ylabel="z (mm)", aspect="equal")
    side.legend(loc="lower left", frameon=False)
    figure.colorbar(shades, ax=side, label="posterior sd of the position (mm)", shrink=0.85)
    _draw_joint(joint, scene.parameters, posterior.draws(), theta)
    figure.suptitle(
        f"{scene.name}: posterior by {posterior.model.forward.kind}, "
        f"checked by FEM: {certificate.verdict} ({certificate.evidence.physics.runs} runs)"
    )
    save(figure, path)


def _draw_joint(
    axis: Axes,
    parameters: Sequence[Parameter],
    draws: Mapping[str, np.ndarray],
    theta: Mapping[str, float],
) -> None:
    """Draw the posterior of the first two parameters in their box, and their truth."""
    first, second = parameters[:2]
    axis.scatter(
        draws[first.name], draws[second.name], s=4, alpha=0.25, lw=0, label="posterior draws"
    )
    axis.plot(theta[first.name], theta[second.name], "k+", ms=14, mew=2, label="truth")
    axis.set(
        xlabel=with_unit(first.name, first.unit),
        ylabel=with_unit(second.name, second.unit),
        xlim=(first.low, first.high),
        ylim=(second.low, second.high),
        title="prior box and posterior",
    )
    axis.legend(loc="upper right", frameon=False)
