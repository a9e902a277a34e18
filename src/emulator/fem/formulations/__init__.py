"""Formulations: how a scene's equations are linearised, and what is iterated on.

At equilibrium it is one of :data:`FORMULATIONS`; on the way there, :mod:`.stress_iterates`.
"""

from emulator.fem.formulations.displacement import Displacement
from emulator.fem.formulations.inverse import Inverse
from emulator.fem.formulations.mean_dilatation import MeanDilatation
from emulator.fem.formulations.protocol import Formulation, Linearised
from emulator.fem.system import System

FORMULATIONS: dict[str, type[Displacement] | type[MeanDilatation] | type[Inverse]] = {
    "inverse motion": Inverse,
    "mean dilatation": MeanDilatation,
    "displacement alone": Displacement,
}
"""By name; the first that serves a scene is taken."""


def formulation_of(system: System) -> Formulation:
    """How Newton's method solves the equations of ``system``."""
    serving = (each for each in FORMULATIONS.values() if each.serves(system))
    return next(serving)(system)


__all__ = ["FORMULATIONS", "Formulation", "Linearised", "formulation_of"]
