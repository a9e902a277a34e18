r"""Pressure that follows an open patch of surface, by its virtual work.

.. math::
    f_a = -p \int N_a(\xi) \,
        \frac{\partial x}{\partial \xi} \times \frac{\partial x}{\partial \eta} \; d\xi\, d\eta

with :math:`x = X + u` on the facet and the normal pointing out of the tissue, against which a
positive pressure pushes. Unless the patch's rim is held, no potential has this force: its tangent
is not symmetric, and a scene with one can be simulated but has no energy to train on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from emulator.geometry.discretisation import Discretisation, facet_rule
from emulator.geometry.facets import area_vectors
from emulator.scenes.fibre_angles import Fibres
from emulator.scenes.loads.dead_pressure import DeadPressure, at_rest
from emulator.scenes.loads.surface_pressure import SurfacePressure
from emulator.scenes.local_terms import LocalForce, Values


@dataclass(frozen=True)
class FollowerPressure(SurfacePressure):
    """Pressure on a patch whose rim may move; positive pushes into the tissue."""

    kind: ClassVar[str] = "follower_pressure"

    @property
    def simpler(self) -> tuple[str, DeadPressure]:
        """The pressure on the patch as it is at rest."""
        return at_rest(self)

    @property
    def has_potential(self) -> bool:
        """No: the tangent of the force is not symmetric."""
        return False

    def force(self, grid: Discretisation) -> LocalForce:
        """The nodal forces, facet by facet."""
        mesh = grid.mesh
        facets = mesh.facet_set(self.facet_set)
        # N_a times the area vector: degree 1 on linear facets, 4 on quadratic ones.
        rule = facet_rule(mesh.order, 1 if mesh.order == 1 else 4)

        def force(u: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            normals = area_vectors(corners + u, rule)
            return -self.value(values) * jnp.einsum(
                "q,qa,qi->ai", rule.weights, rule.values, normals
            )

        return LocalForce(facets, mesh.nodes[facets], force)

    def on_loaded(self, grid: Discretisation, fibres: Fibres | None = None) -> LocalForce:
        """The force on the known surface, whatever the shape at rest."""
        del fibres
        following = self.force(grid)

        def force(w: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            return following.force(jnp.zeros_like(w), corners, values)

        return LocalForce(following.nodes, following.data, force)
