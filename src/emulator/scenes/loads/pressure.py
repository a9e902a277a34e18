r"""Pressure on a surface, as a potential of the displacement.

Exact for a cavity closed at a rim that does not move: the pressure does work on the volume alone,

.. math:: \Pi_p = -p\,[V(u) - V(0)], \qquad
          V = -\frac{1}{3} \int x \cdot n \, da + \text{lid}

for facets whose normals point out of the tissue, into the cavity. The lid is fixed and drops out.
A rim that slides in a plane of symmetry through the origin will do as well: the cone over the
opening, from the origin, then has no volume. Elsewhere a pressure that follows the surface has no
potential: see :mod:`emulator.scenes.loads.follower`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.geometry.facets import cone_volume, enclosed_volume, rim
from emulator.mechanics.kinematics import cofactor
from emulator.mechanics.quantity import Quantity
from emulator.scenes.local_terms import LocalTerm, Values

if TYPE_CHECKING:
    from emulator.scenes.scene import Scene

KPA_PER_MMHG = 0.133322


@dataclass(frozen=True)
class SurfacePressure:
    """A pressure on a facet set.

    Parameters
    ----------
    facet_set : where it acts.
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
    def quantities(self) -> tuple[Quantity, ...]:
        """What this load takes from theta or the constants; suction is negative."""
        if self.pressure is not None:
            return ()
        return (Quantity(self.parameter, "kPa", -np.inf, hint=f"1 mmHg = {KPA_PER_MMHG} kPa"),)

    def describe(self) -> list[object]:
        """What tells this load from another."""
        named = [] if self.parameter == "pressure" else [self.parameter]
        return [type(self).__name__, self.facet_set, self.pressure, *named]

    def value(self, values: Values) -> jax.Array | float:
        """The pressure in kPa among the scene's resolved parameters."""
        return values[self.parameter] if self.pressure is None else self.pressure


@dataclass(frozen=True)
class PotentialPressure(SurfacePressure, ABC):
    """A pressure whose work is a potential of the displacement."""

    @abstractmethod
    def term(self, scene: Scene) -> LocalTerm:
        """The potential of this load on ``scene``."""


@dataclass(frozen=True)
class CavityPressure(PotentialPressure):
    """Pressure in a cavity, exact (``-p V``); the rim of its wall must be held."""

    def term(self, scene: Scene) -> LocalTerm:
        """The potential ``-p [V(u) - V(0)]``."""
        facets = scene.mesh.facet_set(self.facet_set)
        X = scene.mesh.nodes[facets]

        def energy(u: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            return -self.value(values) * (cone_volume(corners) - cone_volume(corners + u))

        return LocalTerm(facets, X, energy)


@dataclass(frozen=True)
class PublishedPressure(PotentialPressure):
    r"""The pressure work of the released code, for reproducing it; not a follower pressure.

    .. math:: \Pi_p = p \int u \cdot \text{cof}(F) N \, dA

    differentiated through :math:`\text{cof}(F)` too. On the released ventricle it acts like a
    pressure 1.39 times larger.
    """

    def term(self, scene: Scene) -> LocalTerm:
        """The released work, one value of ``F`` a facet: that of the element behind it."""
        facets = scene.mesh.facet_set(self.facet_set)
        if scene.mesh.order != 1:
            raise InputError(
                f"pressure on '{self.facet_set}': the published work is defined on linear "
                "tetrahedra; use CavityPressure on quadratic ones"
            )
        behind = scene.mesh.elements_behind(facets)
        corner = scene.mesh.nodes[facets]
        area = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        nodes = scene.mesh.elements[behind]
        on_facet = (nodes[:, :, None] == facets[:, None, :]).any(axis=2)
        gradients = scene.discretisation.gradients[behind, 0]
        data = (area, on_facet / 3.0, gradients)

        def energy(u: jax.Array, data: Any, values: Values) -> jax.Array:
            area, mean, gradients = data
            F = jnp.eye(3, dtype=u.dtype) + u.T @ gradients
            return self.value(values) * jnp.vdot(mean @ u, cofactor(F) @ area)

        return LocalTerm(nodes, data, energy)


def require_held_rim(scene: Scene, name: str) -> None:
    """Refuse the cavity ``name`` unless its rim is held or slides in a plane through the origin."""
    edges = rim(scene.mesh.facet_set(name))
    held = scene.held[edges]  # (e, 2 or 3, 3)
    there = np.where(held, scene.mesh.nodes[edges] + scene.held_displacement[edges], np.nan)
    in_symmetry_plane = (np.abs(there) <= 1e-9 * scene.mesh.size).all(axis=1).any(axis=1)
    loose = np.unique(edges[~(held.all(axis=(1, 2)) | in_symmetry_plane)])
    if loose.size:
        raise InputError(
            f"cavity '{name}': rim node {loose[0]} ({loose.size} such) is not held, so -p V is not "
            "the potential of its pressure; hold the rim or use FollowerPressure"
        )


def cavity_volume(scene: Scene, facet_set: str) -> Callable[[jax.Array], jax.Array]:
    """``u -> V`` in mL of a cavity, its opening closed by a fan from the rim's middle.

    Differentiable; positive where the facets' normals point into the cavity. Lengths are mm, so the
    volume in mm3 is divided by 1000. :class:`~emulator.geometry.cavity.Cavity` needs only the
    facets' own nodes, and is positive whatever the winding.
    """
    outward = enclosed_volume(scene.mesh.facet_set(facet_set))
    X = jnp.asarray(scene.mesh.nodes)
    return lambda u: -outward(X + u) / 1000.0
