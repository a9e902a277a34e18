r"""The discrete equations of a scene: residual, tangent and balance over the free displacements.

.. math::
    r = \frac{\partial \Pi}{\partial u}, \qquad
    K = \frac{\partial^2 \Pi}{\partial u^2}
      = \sum_{e,q} w_{eq}\, B^T \frac{\partial^2 W}{\partial H^2} B

with :math:`B` the shape-function gradients. Dead loads have no tangent; elastic supports and loads
that follow the deformation add the Hessians of their own potentials, or the derivatives of their
forces, facet by facet. With mean dilatation the points of a block are coupled; its tangent is in
:mod:`emulator.fem.condensation`.

A state is judged by its *relative residual*,

.. math::
    \frac{|r|}{|f_\text{int}| + |f_\text{ext}|}

where the norms of the forces include the reactions at prescribed displacements.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.compiled import Number, compiled, is_traced
from emulator.fem.condensation import block_derivatives
from emulator.fem.energy import (
    DeadForce,
    at_points,
    dead_force,
    energy_of_gradient,
    force_on_body,
    law_gradients,
    local_forces,
    local_terms,
    pair_products,
    require_rest,
    spring_terms,
    volume_ratio,
)
from emulator.fem.linear import (
    Outcome,
    Pattern,
    block_pattern,
    upper_blocks,
    whole_blocks,
)
from emulator.fem.linear.reuse import KeptFactor
from emulator.fem.linear.solve import attempt, solve
from emulator.fem.material_point import stress_and_moduli
from emulator.scenes.part import LocalForce, LocalTerm
from emulator.scenes.scene import Scene

_LAST_BITS = 1e-15  # relative difference of prescribed displacements between programs


class Balance(NamedTuple):
    """How far a state is from equilibrium.

    residual : the residual (f,) in mN at free degrees of freedom.
    internal : the norm () in mN of the internal forces, reactions included.
    relative : the norm of the residual relative to the internal and external forces, ().
    """

    residual: jax.Array
    internal: jax.Array
    relative: jax.Array


@dataclass(frozen=True, eq=False)
class System:
    """The discrete equations of a scene; vectors of free displacements have shape (f,).

    scene : the scene, at rest on its mesh.
    """

    scene: Scene

    inverse: ClassVar[bool] = False  # whether the mesh is loaded and its stress-free shape unknown

    def __post_init__(self) -> None:
        require_rest(self.scene)

    @cached_property
    def programs(self) -> dict[Any, Callable[..., Any]]:
        """The compiled functions of these equations (:func:`emulator.fem.compiled.compiled`)."""
        return {}

    @cached_property
    def free(self) -> np.ndarray:
        """Flat indices of the free degrees of freedom, (f,)."""
        free = np.flatnonzero(~self.scene.held.ravel())
        if not len(free):
            raise InputError(f"scene '{self.scene.name}': every node is held, nothing to solve")
        return free

    @cached_property
    def springs(self) -> Sequence[LocalTerm | LocalForce]:
        """Elastic supports; potentials, where :attr:`inverse` is not set."""
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
    def dead(self) -> DeadForce:
        """The dead loads; zero when there are none."""
        return dead_force(self.scene)

    def restrict(self, field: jax.Array) -> jax.Array:
        """Return the free entries (f,) of a nodal field (n, 3)."""
        return field.reshape(-1)[self.free]

    def extend(self, free_values: jax.Array) -> jax.Array:
        """Return the nodal field (n, 3) with ``free_values`` (f,), zero where prescribed."""
        flat = jnp.zeros(self.scene.held.size, dtype=free_values.dtype)
        return flat.at[self.free].set(free_values, unique_indices=True).reshape(-1, 3)

    def scatter(self, local: jax.Array) -> jax.Array:
        """Return the nodal sums (n, 3) of the blocks' vectors (b, ...)."""
        nodes = self.scene.blocks.connectivity
        at_nodes = local.reshape(*nodes.shape, 3)
        return jnp.zeros(self.scene.held.shape, local.dtype).at[nodes].add(at_nodes)

    # Energy and forces

    def internal_energy(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the elastic energy of the body and its springs, mN mm."""
        energy = energy_of_gradient(self.scene, self.scene.gradients(u), theta)
        values = self.scene.resolve(theta)
        return sum((spring.total(u, values) for spring in self.springs), energy)

    internal_force = jax.grad(internal_energy, argnums=1)
    """The gradient of the elastic energy, (n, 3) in mN; at prescribed entries, the reactions."""

    def external_force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the force of the full loads, (n, 3) in mN."""
        force = self.dead_force(theta) + force_on_body(self.terms, u, self.scene.resolve(theta))
        return force + self.follower_force(u, theta)

    def dead_force(self, theta: jax.Array) -> jax.Array:
        """Return the nodal forces of the dead loads, (n, 3) in mN."""
        return self.dead.total(self.scene.resolve(theta))

    @compiled
    def follower_force(self, u: jax.Array, theta: jax.Array) -> Number:
        """Return the force (n, 3) in mN of the loads without a potential; 0 when there are none."""
        return force_on_body(self.forces, u, self.scene.resolve(theta))

    def spring_force(self, u: jax.Array, theta: jax.Array) -> Number:
        """Return the force (n, 3) in mN of the elastic supports on the body; 0 without any."""
        return force_on_body(self.springs, u, self.scene.resolve(theta))

    @compiled
    def potential(
        self, u: jax.Array, theta: jax.Array, load: Number = 1.0, follower_force: Number = 0.0
    ) -> tuple[jax.Array, jax.Array]:
        """Return the potential energy at load factor ``load``, and the size of its parts, in mN mm.

        A load without a potential counts as the dead force ``follower_force`` (n, 3).
        """
        internal, values = self.internal_energy(u, theta), self.scene.resolve(theta)
        work = jnp.vdot(self.dead_force(theta), u)
        if self.forces:
            work = work + jnp.vdot(jnp.asarray(follower_force), u)
        work = work - sum((term.total(u, values) for term in self.terms), 0.0)
        return internal - load * work, jnp.abs(internal) + jnp.abs(load * work)

    def residual(self, u: jax.Array, theta: jax.Array, load: Number = 1.0) -> jax.Array:
        """Return the residual (f,) in mN: internal less ``load`` times external force."""
        return self.restrict(self.internal_force(u, theta) - load * self.external_force(u, theta))

    def residual_of(
        self, forces: jax.Array, u: jax.Array, theta: jax.Array, load: Number
    ) -> jax.Array:
        """Return the residual (f,) in mN from the ``forces`` (b, a, 3) of the blocks."""
        internal = self.scatter(forces) - self.spring_force(u, theta)
        return self.restrict(internal - load * self.external_force(u, theta))

    # Balance

    @compiled
    def balance(self, u: jax.Array, theta: jax.Array, load: Number = 1.0) -> Balance:
        """Return the balance of ``u`` (n, 3) mm at load factor ``load``.

        The relative residual of a body without any forces is 0. NaN stays NaN.
        """
        internal = self.internal_force(u, theta)
        external = load * self.external_force(u, theta)
        residual = self.restrict(internal - external)
        size, norm = jnp.linalg.norm(internal), jnp.linalg.norm(residual)
        scale = size + jnp.linalg.norm(external)
        return Balance(residual, size, norm / jnp.where(scale > 0.0, scale, 1.0))

    def relative_residual(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the norm of the residual relative to the internal and external forces, ()."""
        return self.balance(u, theta).relative

    def admissible_balance(
        self, u: jax.Array, theta: jax.Array, load: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the residual (f,) and its relative norm ().

        The relative norm is infinite where it is not finite, or where ``u`` does not have the
        prescribed displacements.
        """
        residual, _, relative = self.balance(u, theta, load)
        admissible = self.supports_met(u, theta, load) & jnp.isfinite(relative)
        return residual, jnp.where(admissible, relative, jnp.inf)

    # Tangent

    @cached_property
    def pattern(self) -> Pattern:
        """The sparsity of the tangent: the bulk's blocks, then springs, then the loads.

        Of the upper triangle, where every load has a potential.
        """
        entries = whole_blocks if self.inverse else upper_blocks
        parts = (*self.springs, *self.terms, *self.forces)
        groups = [entries(self.scene.blocks.connectivity), *(whole_blocks(p.nodes) for p in parts)]
        # The position of each degree of freedom among the free ones; -1 where prescribed.
        index = np.full(self.scene.held.size, -1)
        index[self.free] = np.arange(len(self.free))
        return block_pattern(groups, index, symmetric=not (self.inverse or self.forces))

    def bulk(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the stiffness (b, pairs, 3, 3) of the blocks, mN/mm, as the pattern has them."""
        scene, law = self.scene, stress_and_moduli(self.scene, theta)
        stress, moduli = at_points(law, law_gradients(scene, u), scene.block_tissue_at(theta))
        return block_derivatives(scene, u, stress, moduli)[1]

    def tangent(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the nonzeros (nnz,) of the tangent over the free degrees of freedom, mN/mm."""
        return self.assemble(self.bulk(u, theta), u, theta, 1.0, 1.0)

    def assemble(
        self, bulk: jax.Array, u: jax.Array, theta: jax.Array, load_stiffness: Number, load: Number
    ) -> jax.Array:
        """Return the nonzeros (nnz,) of the tangent, from the blocks, springs and loads.

        bulk : the stiffness (b, pairs, 3, 3) of the blocks, mN/mm.
        load_stiffness : the factor of the loads' stiffness, 0 to leave it out.
        load : the load factor, which loads with convex potentials have in any case.
        """
        values, parts = self.scene.resolve(theta), self._factors(load_stiffness, load)
        blocks = [bulk, *(factor * part.tangents(u, values) for part, factor in parts)]
        return self.pattern.sum(jnp.concatenate([block.reshape(-1) for block in blocks]))

    def _factors(
        self, load_stiffness: Number, load: Number
    ) -> list[tuple[LocalTerm | LocalForce, Number]]:
        """Return springs and loads that follow the deformation, with factors of their stiffness."""
        springs = [(spring, 1.0) for spring in self.springs]
        terms = [(term, load if term.convex else load_stiffness) for term in self.terms]
        return [*springs, *terms, *((force, load_stiffness) for force in self.forces)]

    def equations(
        self, bulk: jax.Array, u: jax.Array, theta: jax.Array, load_stiffness: Number, load: Number
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return a tangent that solvers accept, whether it is the true one, and a force (f,) in mN.

        The force is the change of the residual, to first order, as the prescribed displacements go
        to their values at the load factor ``load``. The arguments are those of :meth:`assemble`.
        """
        K = self.assemble(bulk, u, theta, load_stiffness, load)
        safe, solvable = self.pattern.safe_values(K), self.pattern.solvable(K)
        nothing = jnp.zeros(len(self.free))
        if self.inverse:  # supports do not move
            return safe, solvable, nothing
        offset, values = self.support_offset(u, theta, load), self.scene.resolve(theta)

        def of_parts(v: jax.Array) -> jax.Array:
            parts = self._factors(load_stiffness, load)
            forces = (factor * force_on_body((part,), v, values) for part, factor in parts)
            return jnp.zeros_like(v) + sum(forces, 0.0)

        def force_of_offset() -> jax.Array:
            force = self.scatter(pair_products(bulk, offset[self.scene.blocks.connectivity]))
            return self.restrict(force - jax.jvp(of_parts, (u,), (offset,))[1])

        force = jax.lax.cond(jnp.any(offset != 0.0), force_of_offset, lambda: nothing)
        return safe, solvable, force

    @compiled
    def step_equations(
        self, u: jax.Array, theta: jax.Array, load_stiffness: Number, load: Number
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return :meth:`equations` with the stiffness of the strain energy."""
        return self.equations(self.bulk(u, theta), u, theta, load_stiffness, load)

    def safe_tangent(
        self, u: jax.Array, theta: jax.Array, load: Number = 1.0
    ) -> tuple[jax.Array, jax.Array]:
        """Return a tangent (nnz,) that solvers accept, and whether it is the true one."""
        return self.step_equations(u, theta, load, load)[:2]

    # Prescribed displacements and admissible states

    def support_offset(self, u: jax.Array, theta: jax.Array, load: Number) -> jax.Array:
        """Return the way (n, 3) in mm of the prescribed displacements to their values at ``load``.

        Fused multiply-add leaves the last bits of products in the difference; they count as none
        (docs/experiments.md, "A fused multiply-add").
        """
        prescribed = load * self.scene.held_at(theta)
        differs = jnp.abs(prescribed - u) > _LAST_BITS * jnp.max(jnp.abs(prescribed))
        return jnp.where(self.scene.held & differs, prescribed - u, 0.0)

    @compiled
    def supports_met(self, u: jax.Array, theta: jax.Array, load: jax.Array) -> jax.Array:
        """Return whether ``u`` (n, 3) has the prescribed displacements of ``load``, ()."""
        return jnp.all(self.support_offset(u, theta, load) == 0.0)

    def residual_on_supports(
        self, u: jax.Array
    ) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
        """Return ``theta -> (residual (f,), v (n, 3))``, v being ``u`` on the supports at theta.

        Its derivatives are those of the equations along theta at an equilibrium ``u``.
        """

        def at(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
            v = self.scene.on_supports(u, theta)
            return self.residual(v, theta), v

        return at

    @compiled
    def least_volume_ratio(self, u: jax.Array) -> jax.Array:
        """Return the smallest ``J``, (): NaN if any is."""
        return jnp.min(volume_ratio(self.scene, u))

    def keeps_volume(
        self, u: jax.Array, step: jax.Array, share: float
    ) -> Callable[[jax.Array], jax.Array]:
        """Return whether a fraction of ``step`` leaves ``share`` of the smallest ``J`` at ``u``."""
        floor = share * self.least_volume_ratio(u)
        return lambda part: floor < self.least_volume_ratio(u + part * step)  # False for NaN

    # Linear systems

    def solve(self, tangent: jax.Array, rhs: jax.Array) -> jax.Array:
        """Return ``x`` (f,) with ``K x = rhs`` for any nonsingular K; NaN where K is singular."""
        return self._compiled(solve)(tangent, rhs)

    def attempt(
        self, tangent: jax.Array, rhs: jax.Array, accuracy: Number = 0.0
    ) -> tuple[jax.Array, jax.Array]:
        """Return ``x`` (f,) with ``K x = rhs`` by Cholesky, and the outcome.

        INDEFINITE, and NaN, where K is symmetric and not positive definite. On a large mesh and for
        numbers, the factor of an earlier tangent may serve, to the relative ``accuracy`` above 0.
        """
        if self.kept is not None and not is_traced(tangent, rhs):
            return self.kept.attempt(tangent, rhs, accuracy)
        return self._compiled(attempt)(tangent, rhs)

    def is_definite(self, tangent: jax.Array) -> bool:
        """Return whether a tangent of numbers is positive definite: it is factorised to see it."""
        zero = jnp.zeros(len(self.free))
        return int(self.attempt(tangent, zero)[1]) == Outcome.OK

    def _compiled(self, how: Callable[..., Any]) -> Callable[..., Any]:
        """Return ``how`` with the tangent's pattern, compiled once."""
        if how not in self.programs:
            self.programs[how] = compiled(partial(how, self.pattern))
        return self.programs[how]

    @cached_property
    def kept(self) -> KeptFactor | None:
        """The factor that serves several tangents; None where factorising is cheap."""
        pays = self.scene.dilatation == "pointwise" and KeptFactor.pays(self.pattern)
        return KeptFactor(self.pattern) if pays else None
