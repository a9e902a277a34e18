"""A whole calibration of a built-in scene: synthetic data, posterior, certificate and figure.

The beam takes under a minute. The left ventricle is the intended use: passive stiffness of the
muscle and filling pressure, from one cavity volume and the displacements of 24 landmarks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import jax
import numpy as np

from calibrate.analysis.identifiability import identify
from calibrate.figures import draw_body, pyplot, save, with_unit
from calibrate.measurements import DISPLACEMENT
from calibrate.measurements.points import DisplacementPoints
from calibrate.posterior import Posterior
from calibrate.project.calibration import certify_and_keep, infer, report
from calibrate.project.problem import simulator_of
from calibrate.project.run import Run
from emulator.core.store import check_folder
from emulator.geometry.mesh import boundary_facets
from emulator.surrogates.network.graph import mesh_edges

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Neither a theta of the training runs nor the centre of the Taylor series.
DEMO = Run(
    scene="once_clamped_beam",
    truth={"mu": 73.0, "lam": 61.0},
    observe="nodes:20",
    noise={"displacement": 0.2},
    forward="emulator",
    seed=2023,
)

# Off the centre of the box in every parameter; 1 kPa is 7.5 mmHg, a normal end-diastolic pressure.
# Real noise is larger than this: observers of one heart differ by several mL in its end-diastolic
# volume, and automatic tracking of points by millimetres.
VENTRICLE = Run(
    scene="left_ventricle",
    truth={"a": 0.36, "b": 1.8, "a_f": 4.6, "b_f": 2.4, "pressure": 1.0},
    observe="landmarks:24+volume",
    noise={"displacement": 0.2, "volume": 1.0},
    forward="emulator",
    warmup=300,
    draws=500,
    seed=2023,
)


def run_demo(
    folder: str | Path, scene: str = "once_clamped_beam", *, progress: bool = False
) -> dict[str, Any]:
    """Run the demo of ``scene``, write its files to ``folder`` and return the report."""
    folder = check_folder(folder)
    pyplot()  # reports a missing plotting package before the sampling
    demo = DEMOS[scene]
    run = demo.run
    posterior = infer(run, folder, force=True, check_map=False, progress=progress)
    certificate = certify_and_keep(posterior, folder, progress=progress)
    forward = posterior.model.full
    truth = simulator_of(forward.scene, run.load_steps)(forward.scene.theta(**run.truth))
    thetas = np.asarray(posterior.thetas())
    rows = np.linspace(0, len(thetas) - 1, 200).astype(int)
    fields = np.asarray(jax.jit(lambda t: jax.lax.map(forward, t))(thetas[rows]))
    figure = demo.figure(posterior, fields, np.asarray(truth), run.truth)
    figure.suptitle(
        f"{forward.scene.name}: posterior by {posterior.model.forward.kind}, "
        f"checked by FEM: {certificate.verdict} ({certificate.evidence.physics.runs} runs)"
    )
    save(figure, folder / demo.picture)
    result = report(run, posterior, certificate)
    result["picture"] = demo.picture
    if demo.identify:
        result["identifiability"] = identify(posterior)
    return result


def _markers(posterior: Posterior) -> tuple[np.ndarray, np.ndarray]:
    """Return the observed points (d, 3) mm at rest, and where they were measured."""
    points = cast(DisplacementPoints, posterior.model.observe.parts[DISPLACEMENT]).points
    return points, points + np.asarray(posterior.data[DISPLACEMENT])


def _draw_beam(
    posterior: Posterior, fields: np.ndarray, truth: np.ndarray, theta: Mapping[str, float]
) -> Figure:
    """Draw the body from the side, true and inferred, and the posterior of theta in its box.

    Reference and truth are lines in x-z, the posterior's mean is points coloured by its sd.
    """
    from matplotlib.collections import LineCollection

    scene, (_, data) = posterior.model.forward.scene, _markers(posterior)
    mesh, draws = scene.mesh, posterior.draws()
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
    points = side.scatter(x, z, c=sd[face], cmap="viridis", s=26, zorder=3, label="posterior mean")
    x, _, z = data.T
    side.scatter(x, z, marker="x", c="tab:red", s=30, lw=1.2, zorder=4, label="data")
    side.set(xlabel="x (mm)", ylabel="z (mm)", aspect="equal")
    side.legend(loc="lower left", frameon=False)
    figure.colorbar(points, ax=side, label="posterior sd of the position (mm)", shrink=0.85)
    first, second = scene.parameters[:2]
    joint.scatter(
        draws[first.name], draws[second.name], s=4, alpha=0.25, lw=0, label="posterior draws"
    )
    joint.plot(theta[first.name], theta[second.name], "k+", ms=14, mew=2, label="truth")
    joint.set(
        xlabel=with_unit(first.name, first.unit),
        ylabel=with_unit(second.name, second.unit),
        xlim=(first.low, first.high),
        ylim=(second.low, second.high),
        title="prior box and posterior",
    )
    joint.legend(loc="upper right", frameon=False)
    return figure


_PRIOR, _POSTERIOR, _DATA = "0.75", "tab:blue", "tab:red"


def _draw_ventricle(
    posterior: Posterior, fields: np.ndarray, truth: np.ndarray, theta: Mapping[str, float]
) -> Figure:
    """Draw the ventricle cut open with its landmarks, marginals, and the cavity's volume."""
    figure = pyplot().figure(figsize=(14.0, 6.6), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.35))
    _draw_body(left, posterior, fields)
    axes = right.subplots(2, 3)
    model = posterior.model
    prior = model.states.thetas(model.prior_draws(jax.random.key(1), 400))[:, 0]
    for panel, parameter in zip(axes.flat, model.forward.scene.parameters, strict=False):
        _draw_marginal(panel, posterior, parameter, theta[parameter.name])
    _draw_volume(axes.flat[-1], posterior, truth, prior)
    axes.flat[0].legend(loc="best", frameon=False, fontsize=8)
    return figure


def _draw_body(figure: Any, posterior: Posterior, fields: np.ndarray) -> None:
    """Draw the half behind the long axis, at the posterior mean, coloured by its sd; landmarks."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    mesh = posterior.model.forward.scene.mesh
    mean = mesh.nodes + fields.mean(axis=0)
    sd = np.sqrt(fields.var(axis=0, ddof=1).sum(axis=-1))
    middle = mesh.nodes[mesh.corners].mean(axis=1)
    facets = boundary_facets(mesh.elements[middle[:, 1] > 0.0])[:, :3]
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    style = {"cmap": "viridis", "edgecolor": "0.3", "lw": 0.15}
    body = draw_body(axes, mean, facets, 1.25, array=sd[facets].mean(axis=1), **style)
    at_rest, measured = _markers(posterior)
    moves = np.stack([at_rest, measured], axis=1)
    axes.add_collection3d(Line3DCollection(list(moves), colors=_DATA, lw=1.3, zorder=3))
    axes.scatter(*measured.T, c=_DATA, s=16, depthshade=False, zorder=4, label="landmarks, moved")
    axes.scatter(
        *at_rest.T, c="white", edgecolors=_DATA, s=16, depthshade=False, zorder=4,
        label="landmarks at rest",
    )  # fmt: skip
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
    label = with_unit(parameter.name, parameter.unit)
    axes.set(xlabel=label, yticks=[], xlim=(parameter.low, parameter.high))


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
        xlabel="predicted cavity volume (mL)", yticks=[], title=f"prior: {low:.0f} to {high:.0f} mL"
    )
    axes.margins(x=0.25, y=0.25)
    axes.legend(loc="upper center", ncols=2, frameon=False, fontsize=8)


@dataclass(frozen=True)
class Demo:
    """A run and its figure.

    figure : draws the posterior, displacement fields (200, n, 3) mm at evenly spaced draws, the
        displacement (n, 3) mm that the data was made from, and the true parameters by name.
    picture : the name of the figure's file.
    identify : whether to report which combinations of parameters the data identifies.
    """

    run: Run
    figure: Callable[[Posterior, np.ndarray, np.ndarray, Mapping[str, float]], Figure]
    picture: str
    identify: bool = False


DEMOS = {
    "once_clamped_beam": Demo(DEMO, _draw_beam, "beam.png"),
    "left_ventricle": Demo(VENTRICLE, _draw_ventricle, "ventricle.png", identify=True),
}
