"""FEM of a specimen between its grips, of higher fidelity than homogeneous states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from calibrate.measurements.specimens import gripped_observations
from calibrate.statistical_model.finer_fem import Known, MeshPair, flat_data
from calibrate.statistical_model.model import Model
from emulator.core.errors import InputError
from emulator.specimens.gripped import GrippedSpecimen
from emulator.specimens.homogeneous import Homogeneous
from emulator.specimens.specimen import Specimen


def gripped_fem(model: Model, states: Homogeneous) -> GrippedFEM:
    """Return FEM between the grips; :class:`InputError` for a specimen without grips."""
    if states.scene.grips is None:
        raise InputError("the states of a specimen are homogeneous on any mesh")
    return GrippedFEM(model, GrippedSpecimen(states.scene))


def is_said_even(specimen: Specimen) -> bool | None:
    """Return whether somebody said that the piece deforms evenly; None for grips and tubes."""
    if specimen.grips is not None or specimen.tube is not None:
        return None
    return specimen.homogeneous


@dataclass(frozen=True, eq=False)
class GrippedFEM:
    """FEM of a specimen between its grips."""

    model: Model
    gripped: GrippedSpecimen

    of = "grips"

    @property
    def nodes(self) -> int:
        """The largest number of nodes of a piece."""
        return max(len(piece.mesh.nodes) for piece in self.gripped.simulators)

    @property
    def workers(self) -> int:
        """The number of draws that are solved at once."""
        return self.gripped.workers

    def __call__(self, draw: Mapping[str, Any], known: Known = ()) -> MeshPair:  # noqa: ARG002
        """Return the data; the grips' stresses are fractions of the homogeneous ones."""
        (theta,) = self.model.states.thetas(draw)
        solution = self.gripped.homogeneous.solve(theta).require_converged("the specimen")
        fields, thetas = [solution.displacement], theta[None]
        shares = self.gripped.shares(theta)
        fine = flat_data(gripped_observations(self.model.observe, shares), fields, thetas)
        return MeshPair(fine, flat_data(self.model.observe, fields, thetas))

    def forget(self) -> None:
        """Do nothing: factors of a piece are small."""
