r"""Residual and tangent of inverse motion: equilibrium on a known loaded shape.

The mesh of the scene, x, is loaded; sought is the displacement w to the stress-free shape X = x + w
(Govindjee & Mihalic 1996, Comput. Methods Appl. Mech. Engng 136, 47-57). With the shape functions
of the mesh, :math:`f = I + \partial w/\partial x`, elements at X are mapped to those at x by
:math:`F = f^{-1}`, and :math:`dX = \det f\, dx`, so that the equations of the scene on the mesh X,
at the displacement u = -w, are

.. math::
    r_a(w) = \sum_q \omega_q\, \sigma(f)\, \nabla_x N_a - f_a^\text{ext}(w) = 0,
    \qquad \sigma = \det f\; P(f^{-1})\, f^{-T}

at free nodes, to round-off: loading the mesh X leads to x. :math:`\omega_q` are the quadrature
weights of x, and :math:`\sigma` is the Cauchy stress (:mod:`emulator.fem.loaded_point`).
A pressure acts on the known shape and does not depend on w; weight and dead tractions are given per
volume and area at rest and do. Held nodes stay where they are.

The tangent is not symmetric, and nothing is a minimum: steps are judged by natural monotonicity
(:mod:`emulator.fem.formulations.inverse`). Elements are in :mod:`emulator.fem.inverse_blocks`.
"""

from __future__ import annotations

from functools import cached_property
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.energy import DeadForce
from emulator.fem.inverse_blocks import block_forces, consistent, linearise
from emulator.fem.linear import Pattern, block_pattern, whole_blocks
from emulator.fem.system import System
from emulator.scenes.local_terms import LocalForce, LocalTerm


class InverseSystem(System):
    """The equations of inverse motion of a scene whose mesh is its loaded shape.

    Its unknown is w, from the loaded shape to the stress-free one; its forces, elastic supports
    included, are those of the loads' and supports' ``on_loaded``.
    """

    inverse: ClassVar[bool] = True

    @cached_property
    def springs(self) -> list[LocalTerm]:
        """None with a potential; see :attr:`resistances`."""
        return []

    @cached_property
    def terms(self) -> list[LocalTerm]:
        """None with a potential."""
        return []

    @cached_property
    def dead(self) -> DeadForce:
        """None that does not depend on w or on the shape: see :attr:`forces`."""
        return DeadForce(np.zeros(self.scene.held.shape), {})

    @cached_property
    def forces(self) -> list[LocalForce]:
        """Loads on the loaded shape."""
        grid, fibres = self.scene.discretisation, self.scene.fibres_of_loads
        return [load.on_loaded(grid, fibres) for load in self.scene.loads]

    @cached_property
    def resistances(self) -> list[LocalForce]:
        """Elastic supports on the loaded shape."""
        grid = self.scene.discretisation
        found = (support.on_loaded(grid) for support in self.scene.supports)
        return [force for force in found if force is not None]

    @cached_property
    def pattern(self) -> Pattern:
        """Sparsity of the tangent: the bulk's blocks, then springs, then the loads."""
        free_index = np.full(self.scene.held.size, -1)
        free_index[self.free] = np.arange(len(self.free))
        groups = [self.scene.blocks.connectivity]
        groups += [part.nodes for part in (*self.resistances, *self.forces)]
        return block_pattern([whole_blocks(g) for g in groups], free_index, symmetric=False)

    def internal_force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Force (n, 3) in mN of the stresses and of the springs."""
        bulk = self.scatter(block_forces(self.scene, u, theta))
        return bulk - self.resistance(u, theta)

    def resistance(self, u: jax.Array, theta: jax.Array) -> jax.Array | float:
        """Force (n, 3) in mN of the springs on the body."""
        values = self.scene.resolve(theta)
        return sum((force.total(u, values) for force in self.resistances), 0.0)

    def others(self, u: jax.Array, theta: jax.Array, load: jax.Array | float) -> jax.Array:
        """Part (n, 3) of the residual outside the bulk, mN: springs less loads."""
        return -self.resistance(u, theta) - load * self.external_force(u, theta)

    def bulk(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Derivatives (b, 3a, 3a) of the blocks' forces in w, mN/mm."""
        volumes = consistent(self.scene, u, theta)
        return linearise(self.scene, u, volumes, theta).tangent

    def assemble(
        self,
        bulk: jax.Array,
        u: jax.Array,
        theta: jax.Array,
        stiffening: jax.Array | float,
        level: jax.Array | float,
    ) -> jax.Array:
        """Nonzeros (nnz,) of the tangent from that of the blocks ``bulk``, springs and loads."""
        del level
        values = self.scene.resolve(theta)
        blocks = [bulk, *(part.tangents(u, values) for part in self.resistances)]
        blocks += [stiffening * part.tangents(u, values) for part in self.forces]
        return self.pattern.sum(jnp.concatenate([block.reshape(-1) for block in blocks]))

    def equations(
        self,
        bulk: jax.Array,
        u: jax.Array,
        theta: jax.Array,
        stiffening: jax.Array | float,
        level: jax.Array | float,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """As a :class:`~emulator.fem.system.System`'s; supports that stay pull nothing."""
        K = self.assemble(bulk, u, theta, stiffening, level)
        return self.pattern.safe_values(K), self.pattern.solvable(K), jnp.zeros(len(self.free))
