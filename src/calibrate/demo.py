"""The main job on the embedded default: a beam, an emulator that ships, a posterior, a check."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from calibrate.figures import beam_figure, pyplot
from calibrate.run import Run, certify_and_keep, infer, report
from emulator.fem import Simulator
from emulator.store import check_folder

# Between the training set's Sobol points, and not the centre the emulator is built around.
DEMO = Run(
    scene="once_clamped_beam",
    truth={"mu": 73.0, "lam": 61.0},
    observe="nodes:20",
    noise_sd=0.2,
    forward="emulator",
    seed=2023,
)


def demo(folder: str | Path, *, progress: bool = False) -> dict[str, Any]:
    """Run the demo, leave posterior, certificate and picture in ``folder``; returns the report."""
    folder = check_folder(folder)
    pyplot()  # a missing plotting package is better found out now
    posterior = infer(DEMO, folder, progress=progress)
    certificate = certify_and_keep(posterior, folder, progress=progress)
    scene = posterior.model.forward.scene
    truth = Simulator(scene)(scene.theta(**DEMO.truth))
    beam_figure(posterior, truth, DEMO.truth, certificate, folder / "beam.png")
    return report(DEMO, posterior, certificate)
