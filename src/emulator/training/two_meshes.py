"""Recipe ``two_meshes``: an emulator on a coarser mesh of the same body, corrected by a few runs.

The emulator on the coarser mesh is given as the start, or made by recipe ``mechanics`` and kept in
the folder ``coarse`` beside the checkpoint. A discrepancy model of FEM runs on the scene's own mesh
adds what the coarser mesh gets wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

from emulator.catalogue import finer_of
from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.fem.campaign import Runs
from emulator.scenes.scene import Scene
from emulator.surrogates.coarse import carried
from emulator.surrogates.emulator import Emulator, load, save_emulator
from emulator.surrogates.taylor import Expansion
from emulator.training.checkpoint import CHECKPOINT, Session, remove_checkpoint
from emulator.training.mechanics import FEM_SHARE, DiscrepancyPlan, Mechanics, of_position
from emulator.training.plan import Job, Plan


@dataclass(frozen=True)
class TwoMeshes(DiscrepancyPlan):
    """An emulator on a coarser mesh, and a discrepancy model."""

    recipe: str = "two_meshes"
    simulations: int = 10

    def default_start(self, job: Job, *, resume: bool) -> Emulator:
        """Return an emulator on the mesh that the scene's is finer than, kept beside the rest."""
        assert job.folder is not None, "a training has one"
        coarse, folder, plan = finer_of(job.scene).coarse, job.folder / "coarse", Mechanics()
        if resume:
            return load(folder, coarse)
        session = Session(folder / CHECKPOINT, coarse.fingerprint, plan)
        below = Job(coarse, progress=job.progress)
        emulator = session.finished(*plan.train(below, session))
        save_emulator(emulator, folder)
        remove_checkpoint(folder)
        return emulator

    def prepare(self, job: Job) -> tuple[Emulator, Runs, Expansion | None]:
        """Return the coarser mesh's emulator on this one, the FEM runs, and FEM's coarse series."""
        emulator = on_finer(job.start, job.scene, self)
        predictor, deadline = of_position(emulator), job.deadline(FEM_SHARE)
        runs = job.fem_runs(Simulator(job.scene), self, predictor, deadline)
        assert job.start is not None, "checked by on_finer"
        return emulator, runs, job.start.taylor


def on_finer(start: Emulator | None, scene: Scene, plan: Plan) -> Emulator:
    """Return ``start``, an emulator on the mesh that the scene's is finer than, on ``scene``.

    Raises :class:`InputError`: no such emulator, a scene that is not on a finer mesh, or one of
    another body.
    """
    body = finer_of(scene)
    if start is None:
        raise InputError(
            f"recipe '{plan.recipe}' stands on an emulator on the coarser mesh; give it as the "
            "start"
        )
    if start.scene.fingerprint != body.coarse.fingerprint:
        raise InputError(
            f"the emulator to start from is of scene '{start.scene.name}' on another mesh; "
            f"expected one of the mesh that finer:{scene.name} refines"
        )
    return Emulator(scene, coarse=carried(start.parts, body))
