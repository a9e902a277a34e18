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
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from emulator.geometry.discretisation import facet_rule
from emulator.geometry.facets import area_vectors
from emulator.scenes.loads.pressure import SurfacePressure
from emulator.scenes.local_terms import LocalForce, Values

if TYPE_CHECKING:
    from emulator.scenes.scene import Scene


@dataclass(frozen=True)
class FollowerPressure(SurfacePressure):
    """Pressure on a patch whose rim may move; positive pushes into the tissue."""

    def forces(self, scene: Scene) -> LocalForce:
        """The nodal forces, facet by facet."""
        facets = scene.mesh.facet_set(self.facet_set)
        # N_a times the area vector: degree 1 on linear facets, 4 on quadratic ones.
        rule = facet_rule(scene.mesh.order, 1 if scene.mesh.order == 1 else 4)

        def force(u: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            normals = area_vectors(corners + u, rule)
            return -self.value(values) * jnp.einsum(
                "q,qa,qi->ai", rule.weights, rule.values, normals
            )

        return LocalForce(facets, scene.mesh.nodes[facets], force)
