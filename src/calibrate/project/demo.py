"""A whole calibration of a built-in scene: synthetic data, posterior and certificate.

The beam takes under a minute. The left ventricle is the intended use: passive stiffness of the
muscle and filling pressure, from one cavity volume and the displacements of 24 landmarks. The beam
has a figure of its own; the ventricle's is its report (:mod:`calibrate.report`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from calibrate.project.calibration import certify_and_keep, infer, report
from calibrate.project.problem import simulator_of
from calibrate.project.run import Run
from emulator.core.rooms import offered
from emulator.core.store import check_folder

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
    is_beam = scene == BEAM.scene
    # A missing plotting package is reported before the sampling.
    drawings = offered("calibrate.figures.beam", "drawing") if is_beam else ()
    draws = [drawing() for drawing in drawings]
    posterior = infer(run, folder, force=True, check_map=False, progress=progress)
    certificate = certify_and_keep(posterior, folder, progress=progress)
    result = report(run, posterior, certificate)
    if is_beam:
        for draw in draws:
            body = posterior.model.forward.scene
            truth = simulator_of(body, run.load_steps)(body.theta(**run.truth))
            draw(posterior, certificate, truth, run.truth, folder / PICTURE)
    else:
        for identify in offered("calibrate.analysis.identifiability", "identify"):
            result["identifiability"] = identify(posterior)
    return result
