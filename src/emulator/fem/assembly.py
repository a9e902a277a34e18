r"""Residual and tangent of a scene's potential energy over its free degrees of freedom.

.. math::
    r = \frac{\partial \Pi}{\partial u}, \qquad
    K = \frac{\partial^2 \Pi}{\partial u^2}
      = \sum_{e,q} w_{eq}\, B^T \frac{\partial^2 W}{\partial H^2} B

with :math:`B` the shape-function gradients. Dead loads have no tangent; those that follow the
deformation add the Hessians of their own potentials, facet by facet.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.fem.sparse import Factorisation, Pattern, block_pattern
from emulator.mechanics.energy import (
    at_points,
    displacement_gradient,
    local_terms,
    nodal_dead_force,
    point_energy,
    strain_energy,
)
from emulator.mechanics.pressure import LocalTerm
from emulator.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class System:
    """The discrete equations of a scene; vectors of free displacements have shape (f,)."""

    scene: Scene
    factorisation: Factorisation = "umfpack"

    @cached_property
    def free(self) -> np.ndarray:
        """Flat indices of the free degrees of freedom, (f,)."""
        free = np.flatnonzero(~self.scene.held.ravel())
        if not len(free):
            raise InputError(f"scene '{self.scene.name}': every node is held, nothing to solve")
        return free

    @cached_property
    def terms(self) -> list[LocalTerm]:
        """Potentials of the loads that follow the deformation."""
        return local_terms(self.scene)

    @cached_property
    def pattern(self) -> Pattern:
        """Sparsity of the tangent: bulk elements, then the loads' local terms."""
        free_index = np.full(self.scene.held.size, -1)
        free_index[self.free] = np.arange(len(self.free))
        groups = [self.scene.discretisation.connectivity, *(term.nodes for term in self.terms)]
        dofs = [(3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1) for nodes in groups]
        return block_pattern(dofs, free_index, symmetric=self.factorisation == "cholmod")

    @cached_property
    def dead_force(self) -> np.ndarray:
        """Nodal forces of the dead loads, (n, 3) in mN; zero when there are none."""
        force = nodal_dead_force(self.scene)
        return np.zeros(self.scene.held.shape) if force is None else force

    def restrict(self, field: jax.Array) -> jax.Array:
        """Free entries (f,) of a nodal field (n, 3)."""
        return field.reshape(-1)[self.free]

    def extend(self, free_values: jax.Array) -> jax.Array:
        """Nodal field (n, 3) with ``free_values`` (f,), zero where held."""
        flat = jnp.zeros(self.scene.held.size, dtype=free_values.dtype)
        return flat.at[self.free].set(free_values, unique_indices=True).reshape(-1, 3)

    def internal_force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Gradient of the strain energy, (n, 3) in mN, reactions included."""
        return jax.grad(strain_energy(self.scene))(u, theta)

    def external_force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Force of the loads at the full level, (n, 3) in mN."""
        if not self.terms:
            return jnp.asarray(self.dead_force)
        values = self.scene.resolve(theta)
        work = jax.grad(lambda v: sum(term.total(v, values) for term in self.terms))
        return self.dead_force - work(u)

    def potential(
        self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0
    ) -> tuple[jax.Array, jax.Array]:
        """Potential energy at ``load`` times the loads, and the size of its parts, in mN mm."""
        internal = strain_energy(self.scene)(u, theta)
        work = jnp.vdot(self.dead_force, u)
        if self.terms:
            values = self.scene.resolve(theta)
            work = work - sum(term.total(u, values) for term in self.terms)
        return internal - load * work, jnp.abs(internal) + jnp.abs(load * work)

    def residual(self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0) -> jax.Array:
        """Free part (f,) of the force out of balance in mN, at ``load`` times the loads."""
        return self.restrict(self.internal_force(u, theta) - load * self.external_force(u, theta))

    def tangent(self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0) -> jax.Array:
        """Nonzeros (nnz,) of the tangent over the free degrees of freedom, mN/mm."""
        grid = self.scene.discretisation
        hessian = jax.hessian(point_energy(self.scene, theta))
        A = at_points(self.scene, hessian, displacement_gradient(self.scene, u))
        A = A * grid.weights[:, :, None, None, None, None]
        bulk = jnp.einsum("mqak,mqikjl,mqbl->maibj", grid.gradients, A, grid.gradients)
        values = self.scene.resolve(theta)
        blocks = [bulk, *(load * term.tangents(u, values) for term in self.terms)]
        return self.pattern.sum(jnp.concatenate([block.reshape(-1) for block in blocks]))

    def solve(self, tangent: jax.Array, rhs: jax.Array) -> jax.Array:
        """Solve ``K x = rhs`` over the free degrees of freedom, shape (f,)."""
        return self.pattern.solve(tangent, rhs, self.factorisation)


def relative_residual(
    system: System, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0
) -> jax.Array:
    """Force out of balance relative to the forces at work, reactions included, shape ()."""
    return balance(system, u, theta, load)[1]


def balance(
    system: System,
    u: jax.Array,
    theta: jax.Array,
    load: jax.Array | float = 1.0,
    negligible: float = 0.0,
) -> tuple[jax.Array, jax.Array]:
    """Free residual (f,) in mN, and its norm relative to the forces at work, shape ().

    ``negligible`` is a norm in mN that counts as none. A body at rest without loads has no forces
    at all, and its relative residual is 0 too. NaN stays NaN.
    """
    internal = system.internal_force(u, theta)
    external = load * system.external_force(u, theta)
    residual = system.restrict(internal - external)
    norm = jnp.sqrt(jnp.sum(residual**2))
    scale = jnp.sqrt(jnp.sum(internal**2)) + jnp.sqrt(jnp.sum(external**2))
    relative = norm / jnp.where(scale > 0.0, scale, 1.0)
    return residual, jnp.where(norm <= negligible, 0.0, relative)
