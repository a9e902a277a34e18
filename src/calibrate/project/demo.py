"""A whole calibration of a built-in scene: synthetic data, posterior and certificate.

The beam takes under a minute. The left ventricle is the intended use: passive stiffness of the
muscle and filling pressure, from one cavity volume and the displacements of 24 landmarks. The beam
has a figure of its own; the ventricle's is its report (:mod:`calibrate.report`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import jax
import numpy as np

from calibrate.analysis.identifiability import identify
from calibrate.figures import pyplot, save, with_unit
from calibrate.measurements import DISPLACEMENT
from calibrate.measurements.points import DisplacementPoints
from calibrate.posterior import Posterior
from calibrate.project.calibration import certify_and_keep, infer, report
from calibrate.project.problem import simulator_of
from calibrate.project.run import Run
from emulator.core.store import check_folder
from emulator.scenes.specimen import with_mesh
from emulator.surrogates.network.graph import mesh_edges

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Neither a theta of the training runs nor the centre of the Taylor series.
BEAM = Run(
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


DEMOS = {run.scene: run for run in (BEAM, VENTRICLE)}
PICTURE = "beam.png"


def run_demo(
    folder: str | Path, scene: str = BEAM.scene, *, progress: bool = False
) -> dict[str, Any]:
    """Run the demo of ``scene``, write its files to ``folder`` and return the report.

    The beam gets a figure, named :data:`PICTURE`; of the ventricle the report says which
    combinations of parameters the data identify.
    """
    folder, run = check_folder(folder), DEMOS[scene]
    if scene == BEAM.scene:
        pyplot()  # reports a missing plotting package before the sampling
    posterior = infer(run, folder, force=True, check_map=False, progress=progress)
    certificate = certify_and_keep(posterior, folder, progress=progress)
    result = report(run, posterior, certificate)
    if scene != BEAM.scene:
        result["identifiability"] = identify(posterior)
        return result
    forward = posterior.model.full
    simulator = simulator_of(forward.scene, run.load_steps)
    truth = simulator.solve(forward.scene.theta(**run.truth)).require_converged().displacement
    thetas = np.asarray(posterior.thetas())
    rows = np.linspace(0, len(thetas) - 1, 200).astype(int)
    fields = np.asarray(jax.jit(lambda t: jax.lax.map(forward, t))(thetas[rows]))
    figure = _draw_beam(posterior, fields, np.asarray(truth), run.truth)
    figure.suptitle(
        f"{forward.scene.name}: posterior by {posterior.model.forward.kind}, "
        f"checked by FEM: {certificate.verdict} ({certificate.evidence.physics.runs} runs)"
    )
    save(figure, folder / PICTURE)
    return result


def _draw_beam(
    posterior: Posterior, fields: np.ndarray, truth: np.ndarray, theta: Mapping[str, float]
) -> Figure:
    """Draw the body from the side, true and inferred, and the posterior of theta in its box.

    Reference and truth are lines in x-z, the posterior's mean is points coloured by its sd.
    """
    from matplotlib.collections import LineCollection

    scene = posterior.model.forward.scene
    points = cast(DisplacementPoints, posterior.model.observe.parts[DISPLACEMENT]).points
    measured = points + np.asarray(posterior.data[DISPLACEMENT])
    mesh, draws = with_mesh(scene).mesh, posterior.draws()
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
