r"""Pressure on a surface; positive pushes into the tissue.

Exact for a cavity closed at a rim that does not move: the pressure does work on the volume alone,

.. math:: \Pi_p = -p\,[V(u) - V(0)], \qquad
          V = -\frac{1}{3} \int x \cdot n \, da + \text{lid}

with the normals of the facets pointing out of the tissue, into the cavity. The lid is fixed and
drops out. A rim may also slide in a plane of symmetry through the origin: the cone over the
opening, from the origin, then has no volume. Elsewhere a pressure that follows the surface has no
potential: see :mod:`emulator.scenes.loads.follower`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np

from emulator.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.geometry.facets import cone_volume, rim
from emulator.geometry.mesh import Mesh
from emulator.mechanics.quantity import Quantity
from emulator.scenes.loads.load import Load
from emulator.scenes.local_terms import LocalTerm, Values

KPA_PER_MMHG = 0.133322


@dataclass(frozen=True)
class SurfacePressure(Load):
    """A pressure on a facet set; subclasses define its virtual work.

    Parameters
    ----------
    facet_set : the surface it acts on.
    pressure : kPa, or ``None`` to make it a parameter of the scene.
    parameter : name of that parameter; give each of several pressures its own.
    """

    facet_set: str
    pressure: float | None = None
    parameter: str = "pressure"

    def __post_init__(self) -> None:
        if self.pressure is not None and not np.isfinite(self.pressure):
            raise InputError(f"pressure on '{self.facet_set}' is {self.pressure} kPa")

    @property
    def facet_sets(self) -> tuple[str, ...]:
        """The facet set it acts on."""
        return (self.facet_set,)

    @property
    def pressed(self) -> str:
        """The facet set it acts on."""
        return self.facet_set

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The pressure, if it is a parameter; suction is negative."""
        if self.pressure is not None:
            return ()
        return (Quantity(self.parameter, "kPa", -np.inf, hint=f"1 mmHg = {KPA_PER_MMHG} kPa"),)

    def to_json(self) -> list[Any]:
        """Kind, facet set, pressure, name of the parameter; one of the last two is None."""
        by_name = self.parameter if self.pressure is None else None
        return [self.kind, self.facet_set, self.pressure, by_name]

    def value(self, values: Values) -> jax.Array | float:
        """The pressure in kPa, taken from the scene's resolved parameters if it is one."""
        return values[self.parameter] if self.pressure is None else self.pressure


@dataclass(frozen=True)
class CavityPressure(SurfacePressure):
    """Pressure in a cavity, exact (``-p V``); the rim of its wall must be held."""

    kind: ClassVar[str] = "cavity_pressure"

    def check(self, mesh: Mesh, held: np.ndarray, displacement: np.ndarray) -> None:
        """Refuse a cavity whose rim is neither held nor slides in a plane through the origin."""
        edges = rim(mesh.facet_set(self.facet_set))
        stays = held[edges]  # (e, 2 or 3, 3)
        there = np.where(stays, mesh.nodes[edges] + displacement[edges], np.nan)
        in_symmetry_plane = (np.abs(there) <= 1e-9 * mesh.size).all(axis=1).any(axis=1)
        loose = np.unique(edges[~(stays.all(axis=(1, 2)) | in_symmetry_plane)])
        if loose.size:
            raise InputError(
                f"cavity '{self.facet_set}': rim node {loose[0]} ({loose.size} such) is not held, "
                "so -p V is not the potential of its pressure; hold the rim or use FollowerPressure"
            )

    def term(self, grid: Discretisation) -> LocalTerm:
        """The potential ``-p [V(u) - V(0)]``."""
        facets = grid.mesh.facet_set(self.facet_set)

        def energy(u: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            return -self.value(values) * (cone_volume(corners) - cone_volume(corners + u))

        return LocalTerm(facets, grid.mesh.nodes[facets], energy)
