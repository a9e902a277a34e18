r"""Pressure on a surface, as a potential of the displacement.

Exact for a cavity closed at a rim that does not move: the pressure does work on the volume alone,

.. math:: \Pi_p = -p\,[V(u) - V(0)], \qquad
          V = -\frac{1}{6} \sum_\text{facets} x_0 \cdot (x_1 \times x_2) + \text{lid}

for facets whose normals point out of the tissue, into the cavity. The lid is fixed and drops out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.mechanics.kinematics import cofactor

if TYPE_CHECKING:
    from emulator.scenes.scene import Scene

KPA_PER_MMHG = 0.133322


@dataclass(frozen=True, eq=False)
class LocalTerm:
    """A sum of local energies.

    nodes : (k, a) nodes each local energy depends on.
    data : NumPy arrays with leading axis k; made under a trace, JAX ones would be its tracers.
    energy : ``energy(u, data_row, values) -> ()`` in mN mm for one of them, ``u`` (a, 3).
    """

    nodes: np.ndarray
    data: Any
    energy: Callable[[jax.Array, Any, Mapping[str, jax.Array]], jax.Array]

    def total(self, u: jax.Array, values: Mapping[str, jax.Array]) -> jax.Array:
        """The sum, shape ()."""
        return jnp.sum(jax.vmap(lambda v, d: self.energy(v, d, values))(u[self.nodes], self.data))

    def tangents(self, u: jax.Array, values: Mapping[str, jax.Array]) -> jax.Array:
        """Hessians (k, 3a, 3a) of the local energies."""
        hessian = jax.vmap(lambda v, d: jax.hessian(self.energy)(v, d, values))
        size = 3 * self.nodes.shape[1]
        return hessian(u[self.nodes], self.data).reshape(-1, size, size)


@dataclass(frozen=True)
class SurfacePressure(ABC):
    """A pressure on a facet set.

    Parameters
    ----------
    facet_set : where it acts.
    pressure : kPa, or ``None`` to make ``pressure`` a parameter of the scene.
    """

    facet_set: str
    pressure: float | None = None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names this load takes from theta or the constants."""
        return () if self.pressure is not None else ("pressure",)

    def describe(self) -> list[object]:
        """What tells this load from another."""
        return [type(self).__name__, self.facet_set, self.pressure]

    def value(self, values: Mapping[str, jax.Array]) -> jax.Array | float:
        """The pressure in kPa among the scene's resolved parameters."""
        return values["pressure"] if self.pressure is None else self.pressure

    @abstractmethod
    def term(self, scene: Scene) -> LocalTerm:
        """The potential of this load on ``scene``."""


@dataclass(frozen=True)
class CavityPressure(SurfacePressure):
    """Pressure in a cavity, exact (``-p V``); the rim of its wall must be held."""

    def term(self, scene: Scene) -> LocalTerm:
        """The potential ``-p [V(u) - V(0)]``."""
        facets = scene.mesh.facet_set(self.facet_set)
        _require_held_rim(scene, self.facet_set, facets)
        X = scene.mesh.nodes[facets]

        def energy(u: jax.Array, corners: jax.Array, values: Mapping[str, jax.Array]) -> jax.Array:
            return -self.value(values) * (_volume(corners) - _volume(corners + u))

        return LocalTerm(facets, X, energy)


@dataclass(frozen=True)
class PublishedPressure(SurfacePressure):
    r"""The pressure work of the released code, for reproducing it; not a follower pressure.

    .. math:: \Pi_p = p \int u \cdot \text{cof}(F) N \, dA

    differentiated through :math:`\text{cof}(F)` too. On the released ventricle it acts like a
    pressure 1.39 times larger.
    """

    def term(self, scene: Scene) -> LocalTerm:
        """The released work, one value of ``F`` a facet: that of the element behind it."""
        facets = scene.mesh.facet_set(self.facet_set)
        behind = scene.mesh.elements_behind(facets)
        corner = scene.mesh.nodes[facets]
        area = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        nodes = scene.mesh.elements[behind]
        on_facet = (nodes[:, :, None] == facets[:, None, :]).any(axis=2)
        gradients = scene.discretisation.gradients[behind, 0]
        data = (area, on_facet / 3.0, gradients)

        def energy(u: jax.Array, data: Any, values: Mapping[str, jax.Array]) -> jax.Array:
            area, mean, gradients = data
            F = jnp.eye(3, dtype=u.dtype) + u.T @ gradients
            return self.value(values) * jnp.vdot(mean @ u, cofactor(F) @ area)

        return LocalTerm(nodes, data, energy)


def _volume(corners: jax.Array) -> jax.Array:
    """Signed volume between the origin and a triangle (3, 3), mm3."""
    return jnp.vdot(corners[0], jnp.cross(corners[1], corners[2])) / 6.0


def rim(facets: np.ndarray) -> np.ndarray:
    """Edges (e, 2) that belong to one facet only, oriented along it."""
    edges = np.concatenate([facets[:, [0, 1]], facets[:, [1, 2]], facets[:, [2, 0]]])
    _, first, counts = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True
    )
    return edges[first[counts == 1]]


def _require_held_rim(scene: Scene, name: str, facets: np.ndarray) -> None:
    loose = np.setdiff1d(rim(facets), np.flatnonzero(scene.held.all(axis=1)))
    if loose.size:
        raise InputError(
            f"cavity '{name}': rim node {loose[0]} ({loose.size} such) is not held, so -p V is not "
            "the potential of its pressure; hold the rim or use a follower pressure"
        )


def cavity_volume(scene: Scene, facet_set: str) -> Callable[[jax.Array], jax.Array]:
    """``u -> V`` in mL of a cavity, its opening closed by a fan from the rim's middle.

    Differentiable. Lengths are mm, so the volume in mm3 is divided by 1000.
    """
    facets = scene.mesh.facet_set(facet_set)
    edges = rim(facets)

    def volume(u: jax.Array) -> jax.Array:
        x = scene.mesh.nodes + u
        wall = jnp.sum(jax.vmap(_volume)(x[facets]))
        if len(edges):
            middle = jnp.mean(x[np.unique(edges)], axis=0)
            # The lid runs against the wall's edges, to close the surface.
            fan = jnp.stack(
                [x[edges[:, 1]], x[edges[:, 0]], jnp.broadcast_to(middle, (len(edges), 3))], axis=1
            )
            wall = wall + jnp.sum(jax.vmap(_volume)(fan))
        return -wall / 1000.0

    return volume
