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

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.compiled import compiled, is_traced
from emulator.fem.condensation import block_derivatives
from emulator.fem.energy import (
    DeadForce,
    at_points,
    dead_force,
    displacement_gradient,
    energy_of_gradient,
    local_forces,
    local_terms,
    pair_products,
    require_rest,
    seen_by_law,
    spring_terms,
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
    factorisation : the name of the linear solver in :data:`emulator.fem.linear.SOLVERS`.
    """

    scene: Scene
    factorisation: str = "suitesparse"

    inverse: ClassVar[bool] = False  # whether the mesh is loaded and its stress-free shape unknown

    def __post_init__(self) -> None:
        require_rest(self.scene)

    @property
    def direct(self) -> Direct:
        """The direct solver of linear systems with the tangent."""
        return find_solver(self.factorisation)

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
    def dead(self) -> DeadForce:
        """The dead loads; zero when there are none."""
        return dead_force(self.scene) or DeadForce(np.zeros(self.scene.held.shape), {})

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
        energy = energy_of_gradient(self.scene, displacement_gradient(self.scene, u), theta)
        if self.springs:
            values = self.scene.resolve(theta)
            energy = energy + sum(spring.total(u, values) for spring in self.springs)
        return energy

    internal_force = jax.grad(internal_energy, argnums=1)
    """The gradient of the elastic energy, (n, 3) in mN; at prescribed entries, the reactions."""

    def external_force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the force of the full loads, (n, 3) in mN."""
        values = self.scene.resolve(theta)
        force = self.dead.total(values)
        if self.terms:
            force = force - jax.grad(lambda v: sum(t.total(v, values) for t in self.terms))(u)
        return force + self.follower_force(u, theta)

    def dead_force(self, theta: jax.Array) -> jax.Array:
        """Return the nodal forces of the dead loads, (n, 3) in mN."""
        return self.dead.total(self.scene.resolve(theta))

    @compiled
    def follower_force(self, u: jax.Array, theta: jax.Array) -> jax.Array | float:
        """Return the force (n, 3) in mN of the loads without a potential; 0 when there are none."""
        values = self.scene.resolve(theta)
        return sum((force.total(u, values) for force in self.forces), 0.0)

    def springs_less_loads(
        self, u: jax.Array, theta: jax.Array, load: jax.Array | float
    ) -> jax.Array:
        """Return the part (n, 3) of the residual in mN that is not the bulk's.

        load : the load factor.
        """
        values = self.scene.resolve(theta)
        springs = jax.grad(lambda w: sum((s.total(w, values) for s in self.springs), 0.0))(u)
        return springs - load * self.external_force(u, theta)

    @compiled
    def potential(
        self,
        u: jax.Array,
        theta: jax.Array,
        load: jax.Array | float = 1.0,
        follower_force: jax.Array | float = 0.0,
    ) -> tuple[jax.Array, jax.Array]:
        """Return the potential energy at load factor ``load``, and the size of its parts, in mN mm.

        A load without a potential counts as the dead force ``follower_force`` (n, 3).
        """
        internal = self.internal_energy(u, theta)
        work = jnp.vdot(self.dead_force(theta), u)
        if self.forces:
            work = work + jnp.vdot(jnp.asarray(follower_force), u)
        if self.terms:
            values = self.scene.resolve(theta)
            work = work - sum(term.total(u, values) for term in self.terms)
        return internal - load * work, jnp.abs(internal) + jnp.abs(load * work)

    def residual(self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0) -> jax.Array:
        """Return the residual (f,) in mN: internal less ``load`` times external force."""
        return self.restrict(self.internal_force(u, theta) - load * self.external_force(u, theta))

    # Balance

    @compiled
    def balance(self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0) -> Balance:
        """Return the balance of ``u`` (n, 3) mm at load factor ``load``.

        The relative residual of a body without any forces is 0. NaN stays NaN.
        """
        internal = self.internal_force(u, theta)
        external = load * self.external_force(u, theta)
        residual = self.restrict(internal - external)
        size, norm = _norm(internal), _norm(residual)
        scale = size + _norm(external)
        return Balance(residual, size, norm / jnp.where(scale > 0.0, scale, 1.0))

    def relative_residual(
        self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0
    ) -> jax.Array:
        """Return the norm of the residual relative to the internal and external forces, ()."""
        return self.balance(u, theta, load).relative

    def admissible_balance(
        self, u: jax.Array, theta: jax.Array, load: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the residual (f,) and its relative norm ().

        The relative norm is infinite where it is not finite, or where ``u`` does not have the
        prescribed displacements.
        """
        residual, _, relative = self.balance(u, theta, load)
        return residual, self._infinite_off_supports(u, theta, load, relative)

    @compiled
    def _infinite_off_supports(
        self, u: jax.Array, theta: jax.Array, load: jax.Array, relative: jax.Array
    ) -> jax.Array:
        met = self.supports_met(u, theta, load)
        return jnp.where(met & jnp.isfinite(relative), relative, jnp.inf)

    # Tangent

    @cached_property
    def pattern(self) -> Pattern:
        """The sparsity of the tangent: the bulk's blocks, then springs, then the loads.

        Of the upper triangle, where every load has a potential.
        """
        local: list[LocalTerm | LocalForce] = [*self.springs, *self.terms, *self.forces]
        bulk = upper_blocks(self.scene.blocks.connectivity)
        groups = [bulk, *(whole_blocks(part.nodes) for part in local)]
        return block_pattern(groups, self.free_index, symmetric=not self.forces)

    @property
    def free_index(self) -> np.ndarray:
        """The position of each degree of freedom among the free ones; -1 where prescribed."""
        index = np.full(self.scene.held.size, -1)
        index[self.free] = np.arange(len(self.free))
        return index

    def bulk(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the stiffness (b, pairs, 3, 3) of the blocks, mN/mm, as the pattern has them."""
        scene = self.scene
        H = seen_by_law(scene, displacement_gradient(scene, u))
        law = stress_and_moduli(scene, theta)
        stress, moduli = at_points(law, scene.block_tissue_at(theta), H)
        return block_derivatives(scene, u, stress, moduli)[1]

    def tangent(self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0) -> jax.Array:
        """Return the nonzeros (nnz,) of the tangent over the free degrees of freedom, mN/mm."""
        return self.assemble(self.bulk(u, theta), u, theta, load, load)

    def assemble(
        self,
        bulk: jax.Array,
        u: jax.Array,
        theta: jax.Array,
        load_stiffness: jax.Array | float,
        load: jax.Array | float,
    ) -> jax.Array:
        """Return the nonzeros (nnz,) of the tangent, from the blocks, springs and loads.

        Parameters
        ----------
        bulk : the stiffness (b, pairs, 3, 3) of the blocks, mN/mm.
        load_stiffness : the factor of the loads' stiffness, 0 to leave it out.
        load : the load factor, which loads with convex potentials have in any case.
        """
        values = self.scene.resolve(theta)
        blocks = [bulk]
        blocks += [spring.tangents(u, values) for spring in self.springs]
        for term in self.terms:
            blocks.append((load if term.convex else load_stiffness) * term.tangents(u, values))
        blocks += [load_stiffness * force.tangents(u, values) for force in self.forces]
        return self.pattern.sum(jnp.concatenate([block.reshape(-1) for block in blocks]))

    def _force_of_tangent(
        self,
        u: jax.Array,
        theta: jax.Array,
        load_stiffness: jax.Array | float,
        load: jax.Array | float,
    ) -> jax.Array:
        """Return the force (n, 3) in mN whose derivative :meth:`assemble` adds to the bulk's."""
        force, values = self.springs_less_loads(u, theta, load_stiffness), self.scene.resolve(theta)
        for term in (term for term in self.terms if term.convex):
            force = force + (load - load_stiffness) * jax.grad(term.total)(u, values)
        return force

    def equations(
        self,
        bulk: jax.Array,
        u: jax.Array,
        theta: jax.Array,
        load_stiffness: jax.Array | float,
        load: jax.Array | float,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return a tangent that solvers accept, whether it is the true one, and a force (f,) in mN.

        The force is the change of the residual, to first order, as the prescribed displacements go
        to their values at the load factor ``load``. The arguments are those of :meth:`assemble`.
        """
        K, scene = self.assemble(bulk, u, theta, load_stiffness, load), self.scene
        offset = self.support_offset(u, theta, load)

        def force_of_offset() -> jax.Array:
            force = self.scatter(pair_products(bulk, offset[scene.blocks.connectivity]))
            rest = lambda v: self._force_of_tangent(v, theta, load_stiffness, load)  # noqa: E731
            return self.restrict(force + jax.jvp(rest, (u,), (offset,))[1])

        nothing = jnp.zeros(len(self.free))
        force = jax.lax.cond(jnp.any(offset != 0.0), force_of_offset, lambda: nothing)
        return self.pattern.safe_values(K), self.pattern.solvable(K), force

    @compiled
    def step_equations(
        self,
        u: jax.Array,
        theta: jax.Array,
        load_stiffness: jax.Array | float,
        load: jax.Array | float,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return :meth:`equations` with the stiffness of the strain energy."""
        return self.equations(self.bulk(u, theta), u, theta, load_stiffness, load)

    def safe_tangent(
        self, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0
    ) -> tuple[jax.Array, jax.Array]:
        """Return a tangent (nnz,) that solvers accept, and whether it is the true one."""
        return self.step_equations(u, theta, load, load)[:2]

    # Prescribed displacements and admissible states

    def support_offset(self, u: jax.Array, theta: jax.Array, load: jax.Array | float) -> jax.Array:
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

    # Linear systems

    def solve(self, tangent: jax.Array, rhs: jax.Array) -> jax.Array:
        """Return ``x`` (f,) with ``K x = rhs`` for any nonsingular K; NaN where K is singular."""
        if self.direct.on_host:
            return solve(self.direct, self.pattern, tangent, rhs)
        return self._solve(tangent, rhs)

    @compiled
    def _solve(self, tangent: jax.Array, rhs: jax.Array) -> jax.Array:
        return solve(self.direct, self.pattern, tangent, rhs)

    def attempt(
        self, tangent: jax.Array, rhs: jax.Array, *, may_reuse: bool = True
    ) -> tuple[jax.Array, jax.Array]:
        """Return ``x`` (f,) with ``K x = rhs`` by Cholesky, and the outcome.

        INDEFINITE, and NaN, where K is symmetric and not positive definite. On a large mesh the
        factor of an earlier tangent may serve, where the arguments are numbers; ``may_reuse`` says
        whether this tangent may resemble the earlier one.
        """
        if self.kept is not None and not is_traced(tangent, rhs):
            return self.kept.attempt(tangent, rhs, may_reuse=may_reuse)
        if self.direct.on_host:
            return attempt(self.direct, self.pattern, tangent, rhs)
        return self._attempt(tangent, rhs)

    @compiled
    def _attempt(self, tangent: jax.Array, rhs: jax.Array) -> tuple[jax.Array, jax.Array]:
        return attempt(self.direct, self.pattern, tangent, rhs)

    @property
    def stepwise(self) -> bool:
        """Whether solves from Python take one compiled step after the other.

        Kept factors, and solvers on the host, are reached only from Python.
        """
        return self.direct.on_host or self.kept is not None

    @cached_property
    def kept(self) -> KeptFactor | None:
        """The factor that serves several tangents; None where factorising is cheap."""
        pays = self.scene.dilatation == "pointwise" and KeptFactor.pays(self.pattern)
        return KeptFactor(self.direct, self.pattern) if pays else None


def _norm(field: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(field**2))
