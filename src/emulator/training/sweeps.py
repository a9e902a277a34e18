"""Recipe ``sweeps``: a polynomial of theta, from the energy alone, without a network.

No FEM solution is needed (:mod:`~emulator.training.box_sweeps`). The sweeps begin at rest, or under
the whole load where the network of a family says, or a series about the centre of the box, which is
one FEM solution. On a finer mesh their polynomial corrects an emulator of the coarser mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.taylor import expand
from emulator.training.box_sweeps import Map, check_sweeps, polynomial_part, sweep_box
from emulator.training.checkpoint import Record, Session
from emulator.training.family import family_on
from emulator.training.mechanics import of_position
from emulator.training.plan import Job, Plan, check_order
from emulator.training.two_meshes import on_finer


@dataclass(frozen=True)
class Sweeps(Plan):
    """A polynomial fitted by sweeps over the box.

    sweeps : the largest number of sweeps.
    order : the order of the series at which they begin; 0 for a body at rest.
    """

    recipe: str = "sweeps"
    sweeps: int = 60
    order: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_at_least(1, "sweeps")
        check_order(self.order)

    def train(self, job: Job, session: Session) -> tuple[Emulator, Record]:
        """Return the emulator and its record."""
        scene, start = job.scene, job.start
        check_sweeps(scene, self.sweeps, at_rest=not self.order and start is None)
        session.write_plan(self)
        simulator = Simulator(scene)
        emulator = Emulator(scene)
        beginning: Map | None = None
        beneath: Map | None = None
        if start is not None and start.family is not None:
            beginning = of_position(Emulator(scene, family=family_on(start, scene)))
        elif start is not None:
            emulator = on_finer(start, scene, self)
            if self.order:
                raise InputError(
                    f"recipe '{self.recipe}': an emulator on the coarser mesh to stand on, and a "
                    f"series of order {self.order} to begin at; give one of them"
                )
            beneath = of_position(emulator)
        elif self.order:
            beginning = expand(simulator, order=self.order)
        state = sweep_box(
            simulator,
            self.sweeps,
            self.seed,
            start=beginning,
            beneath=beneath,
            folder=job.folder,
            deadline=job.deadline(0.99),
            progress=job.progress,
        )
        plan = self.with_counts(sweeps=state.number)
        session.write_plan(plan)
        emulator = replace(emulator, polynomial=polynomial_part(simulator, state))
        return emulator, {**plan.record(), "sweeps": state.record}
