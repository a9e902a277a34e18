"""Recipe ``family``: the network of a family of bodies on one body, without any FEM run."""

from __future__ import annotations

from dataclasses import dataclass

from emulator.core.errors import InputError
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network.family import FamilyNetwork, on_body
from emulator.training.checkpoint import Record, Session
from emulator.training.plan import Job, Plan


@dataclass(frozen=True)
class Family(Plan):
    """A network that has learned a family of bodies, as it is; nothing is trained or fitted."""

    recipe: str = "family"

    def train(self, job: Job, session: Session) -> tuple[Emulator, Record]:  # noqa: ARG002
        """Return the emulator and its record; there is no checkpoint.

        Raises
        ------
        InputError
            No such network is given, or the scene's body is unlike those it has learned.
        """
        if job.start is None or job.start.family is None:
            raise InputError(
                "recipe 'family' takes a network that has learned a family of bodies to a new one; "
                "give it as the start, e.g. ventricle_family"
            )
        part = family_on(job.start, job.scene)
        return Emulator(job.scene, family=part), self.record()


def family_on(start: Emulator, scene: Scene) -> FamilyNetwork:
    """Return the network that ``start`` has learned from a family, on ``scene``."""
    assert start.family is not None, "the caller checks it"
    return on_body(start.family.learned, scene)
