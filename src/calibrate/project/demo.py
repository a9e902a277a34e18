"""A whole calibration of a built-in scene: synthetic data, posterior, certificate and figure.

The beam takes under a minute. The left ventricle is the intended use: passive stiffness of the
muscle and filling pressure, from one cavity volume and the displacements of 24 landmarks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibrate.analysis.identifiability import identify
from calibrate.figures.demo import beam_figure, ventricle_figure
from calibrate.figures.drawing import pyplot
from calibrate.project.calibration import certify_and_keep, infer, report
from calibrate.project.problem import simulator_of
from calibrate.project.run import Run
from emulator.core.store import check_folder

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


@dataclass(frozen=True)
class Demo:
    """A run and its figure.

    figure : draws the figure and writes it to a file called ``picture``.
    identify : whether to report which combinations of parameters the data identifies.
    """

    run: Run
    figure: Callable[..., None]
    picture: str
    identify: bool = False


DEMOS = {
    "once_clamped_beam": Demo(DEMO, beam_figure, "beam.png"),
    "left_ventricle": Demo(VENTRICLE, ventricle_figure, "ventricle.png", identify=True),
}


def run_demo(
    folder: str | Path, scene: str = "once_clamped_beam", *, progress: bool = False
) -> dict[str, Any]:
    """Run the demo of ``scene``, write its files to ``folder`` and return the report."""
    folder = check_folder(folder)
    pyplot()  # reports a missing plotting package before the sampling
    demo = DEMOS[scene]
    run = demo.run
    posterior = infer(run, folder, force=True, progress=progress)
    certificate = certify_and_keep(posterior, folder, progress=progress)
    body = posterior.model.forward.scene
    truth = simulator_of(body, run.load_steps)(body.theta(**run.truth))
    demo.figure(posterior, truth, run.truth, certificate, folder / demo.picture)
    result = report(run, posterior, certificate)
    result["picture"] = demo.picture
    if demo.identify:
        result["identifiability"] = identify(posterior)
    return result
