"""The interface of a hyperelastic law: a name, its parameters, one energy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax

from emulator.mechanics.quantity import Quantity


@dataclass(frozen=True)
class Law:
    """A hyperelastic law; stress and tangent follow by differentiation.

    Parameters
    ----------
    name : key in the registry.
    quantities : its parameters, each with unit and admissible values, in the order ``energy``
        takes them.
    energy : ``energy(strain, *parameters) -> W``, the strain energy density (kPa) of one point.
    fibres : whether the energy reads ``strain.fibre``.
    sheets : whether the energy reads ``strain.sheet`` too.
    shape_moduli : multiplying all of these by a factor multiplies the energy, except its
        volumetric part, by that factor. Regions of a scene scale these; a law without them cannot
        have regions.
    exponential : whether stress grows exponentially with strain. It only affects how the solver
        starts, see :mod:`emulator.fem.formulations.stress_iterates`.
    objective : whether a rotation of the body leaves the energy unchanged. A law of small strains
        is not.
    simpler : laws with one effect less, which take some of its parameters: the effect's name, and
        the law without it.
    """

    name: str
    quantities: tuple[Quantity, ...]
    energy: Callable[..., jax.Array]
    fibres: bool = False
    sheets: bool = False
    shape_moduli: tuple[str, ...] = ()
    exponential: bool = False
    objective: bool = True
    simpler: tuple[tuple[str, Law], ...] = ()

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters, in the order ``energy`` takes them."""
        return tuple(quantity.name for quantity in self.quantities)
