"""Formulations: the unknowns of Newton's method and the linearisation of a scene's equations.

Near equilibrium it is one of :data:`FORMULATIONS`; :mod:`emulator.fem.stress_iterates` far from it.
"""

from emulator.fem.assembly import System
from emulator.fem.formulations.displacement import Displacement, Linearised
from emulator.fem.formulations.mean_dilatation import Inverse, MeanDilatation

FORMULATIONS: dict[str, type[Displacement]] = {
    "inverse motion": Inverse,
    "mean dilatation": MeanDilatation,
    "displacement alone": Displacement,
}
"""By name; the first that serves a scene is taken."""


def formulation_of(system: System) -> Displacement:
    """Return the formulation by which Newton's method solves the equations of ``system``."""
    serving = (formulation for formulation in FORMULATIONS.values() if formulation.serves(system))
    return next(serving)(system)


__all__ = ["FORMULATIONS", "Linearised", "formulation_of"]
