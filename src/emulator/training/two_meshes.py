"""Recipe ``two_meshes``: an emulator on a coarser mesh of the same body, corrected by a few runs.

The emulator on the coarser mesh is given as the start, or made by recipe ``mechanics`` and kept
with the checkpoint. A discrepancy model of FEM runs on the scene's own mesh adds what the coarser
mesh gets wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from emulator.catalogue import finer_of
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene
from emulator.surrogates.coarse import carried
from emulator.surrogates.emulator import Emulator, load, save_emulator
from emulator.training.job import FEM_SHARE, Job, Recipe
from emulator.training.mechanics import Mechanics, add_discrepancy, of_position, train_mechanics
from emulator.training.plan import Plan, check_runs


@dataclass(frozen=True)
class TwoMeshes(Plan):
    """An emulator on a coarser mesh, and a discrepancy model.

    simulations : the number of FEM runs on the scene's own mesh, with their sensitivities.
    """

    recipe: str = "two_meshes"
    simulations: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        check_runs(self.simulations)


def train_two_meshes(plan: TwoMeshes, job: Job) -> Emulator:
    """Return the emulator and its record."""
    start = job.start or _coarse_emulator(job)
    emulator = on_finer(start, job.scene, plan)
    runs = job.fem_runs(plan, of_position(emulator), job.deadline(FEM_SHARE))
    plan = replace(plan, simulations=len(runs.theta) - 1)
    emulator, choice = add_discrepancy(emulator, runs, start.taylor)
    return replace(emulator, record={**plan.record(), "discrepancy": choice})


def _coarse_emulator(job: Job) -> Emulator:
    """Return an emulator on the mesh that the scene's is finer than, kept with the checkpoint."""
    assert job.folder is not None, "a training has one"
    coarse, folder = finer_of(job.scene).coarse, job.folder / "coarse"
    if not (folder / "emulator.json").is_file():
        emulator = train_mechanics(Mechanics(), Job(coarse, progress=job.progress))
        save_emulator(emulator, folder)
    return load(folder, coarse)


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


TWO_MESHES = Recipe(TwoMeshes(), train_two_meshes)
