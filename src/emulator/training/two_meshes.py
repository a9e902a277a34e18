"""Recipe ``two_meshes``: an emulator on a coarser mesh of the same body, corrected by a few runs.

The emulator on the coarser mesh is given as the start, or made by recipe ``mechanics`` and kept in
the folder ``coarse`` beside the checkpoint. A discrepancy model of FEM runs on the scene's own mesh
adds what the coarser mesh gets wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import jax

from emulator.catalogue import finer_of
from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.scenes.scene import Scene
from emulator.surrogates.coarse import carried
from emulator.surrogates.emulator import Emulator, load, save_emulator
from emulator.training.checkpoint import CHECKPOINT, Record, Session, remove_checkpoint
from emulator.training.mechanics import FEM_SHARE, Mechanics, add_discrepancy
from emulator.training.plan import Job, Plan


@dataclass(frozen=True)
class TwoMeshes(Plan):
    """An emulator on a coarser mesh, and a discrepancy model.

    Parameters
    ----------
    simulations : the number of FEM runs on the scene's own mesh, with their sensitivities.
    """

    recipe: str = "two_meshes"
    simulations: int = 10
    needs_slopes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_runs()

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

    def train(self, job: Job, session: Session) -> tuple[Emulator, Record]:
        """Return the emulator and its record."""
        emulator = on_finer(job.start, job.scene, self)
        predictor, deadline = of_position(emulator), job.deadline(FEM_SHARE)
        runs = job.fem_runs(Simulator(job.scene), self, predictor, deadline)
        plan = self.with_counts(simulations=len(runs.theta) - 1)
        session.write_plan(plan)
        assert job.start is not None, "checked by on_finer"
        emulator, choice = add_discrepancy(emulator, runs, job.start.taylor)
        return emulator, {**plan.record(), "discrepancy": choice}


def on_finer(start: Emulator | None, scene: Scene, plan: Plan) -> Emulator:
    """Return ``start``, an emulator on the mesh that the scene's is finer than, on ``scene``.

    Raises
    ------
    InputError
        No such emulator, a scene that is not on a finer mesh, or one of another body.
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


def of_position(emulator: Emulator) -> Callable[[jax.Array], jax.Array]:
    """Return the cached ``emulator`` as a function of the position in the unit box."""
    cached = emulator.cache()
    return lambda position: cached(emulator.scene.from_unit(position))
