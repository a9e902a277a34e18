"""Formulations: how a scene's equations are linearised, and what is iterated on.

At equilibrium it is one of :data:`FORMULATIONS`; on the way there, :mod:`.stress_iterates`.
"""

from emulator.fem.assembly import System

from .displacement import Displacement
from .mean_dilatation import MeanDilatation
from .protocol import Formulation, Linearised

FORMULATIONS: dict[str, type[Displacement] | type[MeanDilatation]] = {
    "pointwise": Displacement,
    "mean": MeanDilatation,
    "patch": MeanDilatation,
}
"""By the dilatation of the scene."""


def formulation_of(system: System) -> Formulation:
    """How Newton's method solves the equations of ``system``."""
    return FORMULATIONS[system.scene.dilatation](system)


__all__ = ["FORMULATIONS", "Formulation", "Linearised", "formulation_of"]
