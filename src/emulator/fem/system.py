r"""Residual and tangent of a scene's potential energy over its free degrees of freedom.

.. math::
    r = \frac{\partial \Pi}{\partial u}, \qquad
    K = \frac{\partial^2 \Pi}{\partial u^2}
      = \sum_{e,q} w_{eq}\, B^T \frac{\partial^2 W}{\partial H^2} B

with :math:`B` the shape-function gradients. Dead loads have no tangent; elastic supports and loads
that follow the deformation add the Hessians of their own potentials, or the derivatives of their
forces, facet by facet. With mean dilatation the points of a block are coupled; its tangent is in
:mod:`emulator.fem.condensation`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.condensation import block_derivatives
from emulator.fem.energy import (
    DeadForce,
    at_points,
    dead_force,
    displacement_gradient,
    local_forces,
    local_terms,
    pair_products,
    require_rest,
    seen_by_law,
    spring_terms,
    strain_energy,
    volume_ratio,
)
from emulator.fem.linear import (
    Direct,
    Pattern,
    block_pattern,
    find_solver,
    upper_blocks,
    whole_blocks,
)
from emulator.fem.linear.reuse import KeptFactor
from emulator.fem.linear.solve import attempt, solve
from emulator.fem.loop import compiled
from emulator.fem.material_point import stress_and_moduli
from emulator.scenes.local_terms import LocalForce, LocalTerm
from emulator.scenes.scene import Scene

_LAST_BITS = 1e-15  # of prescribed displacements, which two programs may round differently


@dataclass(frozen=True, eq=False)
class System:
    """The discrete equations of a scene; vectors of free displacements have shape (f,).

    factorisation : by its name in :data:`emulator.fem.linear.SOLVERS`.
    """

    scene: Scene
    factorisation: str = "suitesparse"

    inverse: ClassVar[bool] = False  # whether the mesh is the loaded shape, and rest is sought

    def __post_init__(self) -> None:
        require_rest(self.scene)

    @property
    def direct(self) -> Direct:
        """What solves with the tangent."""
        return find_solver(self.factorisation)

    @cached_property
    def programs(self) -> dict[Callable, Callable]:
        """Its compiled functions (:mod:`emulator.fem.loop`)."""
        return {}

    @cached_property
    def free(self) -> np.ndarray:
        """Flat indices of the free degrees of freedom, (f,)."""
        free = np.flatnonzero(~self.scene.held.ravel())
        if not len(free):
            raise InputError(f"scene '{self.scene.name}': every node is held, nothing to solve")
        return free

    @cached_property
    def springs(self) -> list[LocalTerm]:
        """Potentials of the elastic supports."""
        return spring_terms(self.scene)

    @cached_property
    def terms(self) -> list[LocalTerm]:
        """Potentials of the loads that follow the deformation."""
        return local_terms(self.scene)

    @cached_property
    def forces(self) -> list[LocalForce]:
        """Loads that follow the deformation and have no potential."""
        return local_forces(self.scene)

    @cached_property
    def pattern(self) -> Pattern:
        """Sparsity of the tangent: the bulk's blocks, then springs, then the loads.

        The upper triangle, where every load has a potential.
        """
        free_index = np.full(self.scene.held.size, -1)
        free_index[self.free] = np.arange(len(self.free))
        local: list[LocalTerm | LocalForce] = [*self.springs, *self.terms, *self.forces]
        bulk = upper_blocks(self.scene.blocks.connectivity)
        groups = [bulk, *(whole_blocks(part.nodes) for part in local)]
        return block_pattern(groups, free_index, symmetric=not self.forces)

    @cached_property
    def dead(self) -> DeadForce:
        """The dead loads; zero when there are none."""
        return dead_force(self.scene) or DeadForce(np.zeros(self.scene.held.shape), {})

    def dead_force(self, theta: jax.Array) -> jax.Array:
        """Nodal forces of the dead loads, (n, 3) in mN."""
        return self.dead.total(self.scene.resolve(theta))

    def restrict(self, field: jax.Array) -> jax.Array:
        """Free entries (f,) of a nodal field (n, 3)."""
        return field.reshape(-1)[self.free]

    def extend(self, free_values: jax.Array) -> jax.Array:
        """Nodal field (n, 3) with ``free_values`` (f,), zero where held."""
        flat = jnp.zeros(self.scene.held.size, dtype=free_values.dtype)
        return flat.at[self.free].set(free_values, unique_indices=True).reshape(-1, 3)

    def internal_energy(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Elastic energy of the body and its springs, mN mm."""
        energy = strain_energy(self.scene)(u, theta)
        if self.springs:
            values = self.scene.resolve(theta)
            energy = energy + sum(spring.total(u, values) for spring in self.springs)
        return energy

    def internal_force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Gradient of the elastic energy, (n, 3) in mN; at held entries, the reactions."""
        return jax.grad(self.internal_energy)(u, theta)

    def external_force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Force of the loads at the full level, (n, 3) in mN."""
        values = self.scene.resolve(theta)
        force = self.dead.total(values)
        if self.terms:
            force = force - jax.grad(lambda v: sum(t.total(v, values) for t in self.terms))(u)
        return force + self.follower_force(u, theta)

    @compiled
    def follower_force(self, u: jax.Array, theta: jax.Array) -> jax.Array | float:
        """Force (n, 3) in mN of the loads without a potential; 0 when there are none."""
        values = self.scene.resolve(theta)
        return sum((force.total(u, values) for force in self.forces), 0.0)

    @compiled
    def potential(
        self,
        u: jax.Array,
        theta: jax.Array,
        load: jax.Array | float = 1.0,
        follower_force: jax.Array | float = 0.0,
    ) -> tuple[jax.Array, jax.Array]:
        """Potential energy at ``load`` times the loads, and the size of its parts, in mN mm.

        A load without a potential counts as the dead force ``follower_force`` (n, 3).
        """
        stored = self.internal_energy(u, theta)
        work = jnp.vdot(self.dead_force(theta), u)
        if self.forces:
            work = work + jnp.vdot(jnp.asarray(follower_force), u)
        if self.terms:
            values = self.scene.resolve(theta)
            work = work - sum(term.total(u, values) for term in self.terms)
        return stored - load * work, jnp.abs(stored) + jnp.abs(load * work)

    def residual(self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0) -> jax.Array:
        """Residual (f,) in mN: internal less ``load`` times external force, free entries."""
        return self.restrict(self.internal_force(u, theta) - load * self.external_force(u, theta))

    def scatter(self, local: jax.Array) -> jax.Array:
        """Nodal sums (n, 3) of the blocks' vectors (b, ...)."""
        nodes = self.scene.blocks.connectivity
        at_nodes = local.reshape(*nodes.shape, 3)
        return jnp.zeros(self.scene.held.shape, local.dtype).at[nodes].add(at_nodes)

    def others(self, u: jax.Array, theta: jax.Array, load: jax.Array | float) -> jax.Array:
        """Part (n, 3) of the residual outside the bulk, mN: springs less loads."""
        values = self.scene.resolve(theta)
        springs = jax.grad(lambda w: sum((s.total(w, values) for s in self.springs), 0.0))(u)
        return springs - load * self.external_force(u, theta)

    def _stiffening_others(
        self,
        u: jax.Array,
        theta: jax.Array,
        stiffening: jax.Array | float,
        level: jax.Array | float,
    ) -> jax.Array:
        """Force (n, 3) in mN whose derivative :meth:`assemble` adds to the tangent of the bulk."""
        force, values = self.others(u, theta, stiffening), self.scene.resolve(theta)
        for term in (term for term in self.terms if term.convex):
            force = force + (level - stiffening) * jax.grad(term.total)(u, values)
        return force

    def tangent(self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0) -> jax.Array:
        """Nonzeros (nnz,) of the tangent over the free degrees of freedom, mN/mm."""
        return self.assemble(self.bulk(u, theta), u, theta, load, load)

    def assemble(
        self,
        bulk: jax.Array,
        u: jax.Array,
        theta: jax.Array,
        stiffening: jax.Array | float,
        level: jax.Array | float,
    ) -> jax.Array:
        """Nonzeros (nnz,) of the tangent from that of the blocks ``bulk``, springs and loads.

        stiffening : level of the loads there, ``level`` : of those with convex potentials.
        """
        values = self.scene.resolve(theta)
        blocks = [bulk]
        blocks += [spring.tangents(u, values) for spring in self.springs]
        for term in self.terms:
            blocks.append((level if term.convex else stiffening) * term.tangents(u, values))
        blocks += [stiffening * force.tangents(u, values) for force in self.forces]
        return self.pattern.sum(jnp.concatenate([block.reshape(-1) for block in blocks]))

    def bulk(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Second derivatives (b, pairs, 3, 3) of the strain energy, mN/mm, as in the pattern."""
        scene = self.scene
        H = seen_by_law(scene, displacement_gradient(scene, u))
        law = stress_and_moduli(scene, theta)
        stress, moduli = at_points(law, scene.block_tissue_at(theta), H)
        return block_derivatives(scene, u, stress, moduli)[1]

    def equations(
        self,
        bulk: jax.Array,
        u: jax.Array,
        theta: jax.Array,
        stiffening: jax.Array | float,
        level: jax.Array | float,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Tangent that a solver does not raise on, whether it is the tangent's, and the pull.

        bulk : tangents (b, pairs, 3, 3) of the blocks. stiffening : level of the loads whose
        stiffness is in the tangent. The pull (f,) in mN is what the tangent makes of the way that
        the supports have to the load level ``level``.
        """
        K, scene = self.assemble(bulk, u, theta, stiffening, level), self.scene
        offset = self.support_offset(u, theta, level)

        def pulled() -> jax.Array:
            force = self.scatter(pair_products(bulk, offset[scene.blocks.connectivity]))
            others = lambda v: self._stiffening_others(v, theta, stiffening, level)  # noqa: E731
            return self.restrict(force + jax.jvp(others, (u,), (offset,))[1])

        nothing = jnp.zeros(len(self.free))
        pull = jax.lax.cond(jnp.any(offset != 0.0), pulled, lambda: nothing)
        return self.pattern.safe_values(K), self.pattern.solvable(K), pull

    @compiled
    def step_equations(
        self,
        u: jax.Array,
        theta: jax.Array,
        stiffening: jax.Array | float,
        level: jax.Array | float,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """:meth:`equations` of the strain energy's own tangent."""
        return self.equations(self.bulk(u, theta), u, theta, stiffening, level)

    def safe_tangent(
        self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0
    ) -> tuple[jax.Array, jax.Array]:
        """Nonzeros (nnz,) that a solver does not raise on, and whether they are the tangent's."""
        return self.step_equations(u, theta, load, load)[:2]

    def support_offset(self, u: jax.Array, theta: jax.Array, level: jax.Array | float) -> jax.Array:
        """Distance (n, 3) in mm of the held displacements from their values at ``level``."""
        wanted = level * self.scene.held_at(theta)
        # Fused multiply-add finds the last bits of products missing in the difference
        # (docs/experiments.md, "A fused multiply-add").
        apart = jnp.abs(wanted - u) > _LAST_BITS * jnp.max(jnp.abs(wanted))
        return jnp.where(self.scene.held & apart, wanted - u, 0.0)

    @compiled
    def supports_met(self, u: jax.Array, theta: jax.Array, level: jax.Array) -> jax.Array:
        """Whether the held displacements of ``u`` (n, 3) are those of ``level``, shape ()."""
        return jnp.all(self.support_offset(u, theta, level) == 0.0)

    def moved_supports(self, u: jax.Array) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
        """Of theta (p,): the residual (f,) in mN of ``u`` (n, 3) mm on its supports, and that u.

        For derivatives along theta at an equilibrium ``u``.
        """

        def at(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
            v = self.scene.on_supports(u, theta)
            return self.residual(v, theta), v

        return at

    @compiled
    def least_volume_ratio(self, u: jax.Array) -> jax.Array:
        """The smallest ``J``, shape (): NaN if any is."""
        return jnp.min(volume_ratio(self.scene, u))

    def solve(self, tangent: jax.Array, rhs: jax.Array) -> jax.Array:
        """``x`` (f,) with ``K x = rhs`` over the free degrees of freedom; NaN where K is singular.

        Whatever the signs of its eigenvalues.
        """
        if self.direct.on_host:
            return solve(self.direct, self.pattern, tangent, rhs)
        return self._solve(tangent, rhs)

    @compiled
    def _solve(self, tangent: jax.Array, rhs: jax.Array) -> jax.Array:
        return solve(self.direct, self.pattern, tangent, rhs)

    def attempt(
        self, tangent: jax.Array, rhs: jax.Array, *, near: bool = True
    ) -> tuple[jax.Array, jax.Array]:
        """:meth:`solve` of a tangent that ought to be positive definite, and the outcome.

        INDEFINITE, and NaN, where it is symmetric and is not. On a large mesh, where tangent and
        right-hand side are numbers, the factor of another tangent may serve; ``near`` says whether
        this one may be like that.
        """
        traced = any(isinstance(x, jax.core.Tracer) for x in (tangent, rhs))
        if self.kept is not None and not traced:
            return self.kept.attempt(tangent, rhs, near=near)
        if self.direct.on_host:
            return attempt(self.direct, self.pattern, tangent, rhs)
        return self._attempt(tangent, rhs)

    @compiled
    def _attempt(self, tangent: jax.Array, rhs: jax.Array) -> tuple[jax.Array, jax.Array]:
        return attempt(self.direct, self.pattern, tangent, rhs)

    @property
    def stepwise(self) -> bool:
        """Whether a loop over solves is better Python's, where the numbers are known.

        A factor that is kept, and a solver on the host, are reached from there only.
        """
        return self.direct.on_host or self.kept is not None

    @cached_property
    def kept(self) -> KeptFactor | None:
        """The factor that serves other tangents; None where the matrices are small."""
        pays = self.scene.dilatation == "pointwise" and KeptFactor.pays(self.pattern)
        return KeptFactor(self.direct, self.pattern) if pays else None
