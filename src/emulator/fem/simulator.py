"""The FEM simulator: theta to displacement, differentiable through the equilibrium it solves.

Derivatives are those of the equilibrium (:mod:`emulator.fem.implicit`), not of the iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.core.machine import require_cpu
from emulator.core.precision import require_float64
from emulator.core.representation import TableRepr
from emulator.fem.implicit import (
    Equations,
    Found,
    Quantity,
    adjoint,
    derivatives,
    differentiable,
)
from emulator.fem.linear import Outcome, find_solver
from emulator.fem.loaded import LoadedEquilibrium
from emulator.fem.loop import scan
from emulator.fem.options import NewtonOptions
from emulator.fem.reactions import balanced, nodes_of, reactions
from emulator.fem.solution import Solution
from emulator.fem.system import System
from emulator.scenes.scene import Scene


@dataclass(frozen=True, eq=False, repr=False)
class Simulator(TableRepr):
    """Finite elements for a scene; use it alone, under ``jit``, ``vmap`` or ``grad``.

    Parameters
    ----------
    scene : what to simulate.
    options : controls of Newton's method.
    factorisation : ``suitesparse``: CHOLMOD where it works and UMFPACK where it does not; or
        ``petsc`` (an extra): MUMPS, for meshes whose factors do not fit (docs/large_meshes.md).

    Raises
    ------
    InputError
        A factorisation that is unknown or not installed, or JAX's default device is no CPU.
    """

    scene: Scene
    options: NewtonOptions = field(default_factory=NewtonOptions)
    factorisation: str = "suitesparse"

    def __post_init__(self) -> None:
        require_cpu("FEM")
        find_solver(self.factorisation)
        if self.scene.loaded_by:
            self._loaded.unloader  # noqa: B018 - what cannot be unloaded is named first

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """What it simulates and how."""
        unknowns = int((~self.scene.held).sum())
        _, rows = self.scene.summary_rows()
        how = [("unknowns", str(unknowns)), ("factorisation", self.factorisation)]
        return f"Simulator of '{self.scene.name}'", [*rows, *how]

    @cached_property
    def system(self) -> System:
        """Residual and tangent of the scene."""
        return System(self.scene, self.factorisation)

    @cached_property
    def _balanced(self) -> System:
        return System(balanced(self.scene))

    @cached_property
    def _loaded(self) -> LoadedEquilibrium:
        return LoadedEquilibrium(self.scene, self.options, self.factorisation)

    @property
    def stepwise(self) -> bool:
        """Whether solves are better taken step by step from Python."""
        return not self.scene.loaded_by and self.system.stepwise

    @property
    def rest(self) -> jax.Array:
        """The undeformed state, (n, 3)."""
        return jnp.zeros(self.scene.held.shape)

    def solve(self, theta: jax.Array, start: jax.Array | None = None) -> Solution:
        """Equilibrium at ``theta`` (p,), from ``start`` (n, 3) mm or from rest.

        A soft body may have several equilibria. The one sought is the end of the loading path from
        rest, in Python as under ``jit``, ``vmap`` and ``grad``; :mod:`emulator.fem.continuation`
        has the strategy. An answer from ``start`` is kept if Newton's method came to it at the full
        load in a few full steps, each down the potential; otherwise ``start`` is left and the body
        is loaded from rest.

        What this cannot exclude: a ``start`` close to another equilibrium leads there in a few
        good steps, or is one already; a path that jumps where it loses stability may jump
        elsewhere with other load steps. ``NewtonOptions.load_steps`` follows the path in small
        steps, whatever the start.

        Of a scene whose mesh is loaded, the displacement is that from the mesh, and rest the
        unloaded shape, which is found first (:mod:`emulator.fem.loaded`).

        The displacement is differentiable in ``theta``. Never raises on a hard case: read
        ``status``. ``vmap`` solves one theta after the other.

        Raises
        ------
        InputError
            ``theta`` or ``start`` has the wrong shape, or float64 is off.
        """
        require_float64("FEM")
        if self.scene.loaded_by:
            theta, place = self._checked(theta, self.rest if start is None else start)
            return self._loaded.solve(theta, None if start is None else place)
        theta, start = self._checked(theta, self.rest if start is None else start)
        return self._equilibrium(theta, jax.lax.stop_gradient(start))

    def path(self, thetas: jax.Array) -> Solution:
        """Equilibria along a path of theta (m, p), such as a loading curve; fields gain an axis m.

        Each is sought from the two before it, continued along their difference, and the first one
        (and one after a body at rest) from rest: a curve of many points costs a few iterations a
        point. Differentiable as :meth:`solve` is.

        Raises
        ------
        InputError
            ``thetas`` has the wrong shape, or float64 is off.
        """
        thetas = jnp.asarray(thetas, dtype=float)
        if thetas.ndim != 2 or not len(thetas):
            raise InputError(
                f"scene '{self.scene.name}': path has shape {thetas.shape}; expected "
                f"(m, {len(self.scene.parameters)})"
            )

        def onwards(
            before: tuple[jax.Array, jax.Array], theta: jax.Array
        ) -> tuple[tuple[jax.Array, jax.Array], Solution]:
            u, earlier = before
            ahead = self.scene.on_supports(2.0 * u - earlier, theta)
            # At rest there is nothing to continue, and supports that jump alone crush elements.
            found = self.solve(theta, jnp.where(jnp.any(u != 0.0), ahead, self.rest))
            return (found.displacement, u), found

        found: Solution = scan(onwards, (self.rest, self.rest), thetas)[1]
        return found

    def sensitivities(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Derivatives (p, n, 3) of the equilibrium ``u`` (n, 3) mm in each entry of ``theta`` (p,).

        One tangent and one factor serve them all: on a ventricle with five parameters they take a
        tenth of the time of the solve they follow. For numbers; under ``jit`` differentiate
        :meth:`solve`. Of a force or a volume alone, :meth:`gradient_of` is cheaper.

        Raises
        ------
        SolverError
            The tangent is singular.
        """
        theta, u = self._checked(theta, u, "displacement")
        if self.scene.loaded_by:
            found = self._loaded.sensitivities(u, theta)
        else:
            found = derivatives(self.system, self.tangent(u, theta), u, theta)
        if not isinstance(found, jax.core.Tracer) and not np.isfinite(found).all():
            raise SolverError(
                f"scene '{self.scene.name}': the equilibrium has no derivatives: singular tangent"
            )
        return found

    def gradient_of(
        self, quantity: Quantity
    ) -> Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        """A program that gives a quantity of an equilibrium and its derivatives in theta.

        ``quantity(u, theta)`` is a number () of displacements (n, 3) mm and theta (p,), such as
        the force of a support. The program takes an equilibrium (n, 3) mm and its theta (p,), and
        gives the number and its gradient (p,): one more solve with the tangent, however many
        parameters there are. Keep it: each call of this method compiles one. For numbers; NaN
        where the tangent is singular.
        """
        if not self.scene.loaded_by:
            return adjoint(self.system, quantity)
        both = jax.jit(jax.value_and_grad(quantity, (0, 1)))

        def along_theta(u: jax.Array, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
            value, (by_u, by_theta) = both(u, theta)
            return value, by_theta + jnp.tensordot(self.sensitivities(u, theta), by_u, 2)

        return along_theta

    def is_stable(self, u: jax.Array, theta: jax.Array) -> bool:
        """Whether the equilibrium ``u`` (n, 3) mm at ``theta`` (p,) is a minimum of the energy.

        Its tangent is then positive definite. At a saddle, such as a column that stays straight
        under twice its critical load, forces balance but any disturbance leads away. Of a scene
        whose mesh is loaded, it is the body loaded from its stress-free shape that is asked. For
        numbers, not under ``jit``.

        Raises
        ------
        InputError
            A load without a potential: there is no energy to be least.
        """
        theta, u = self._checked(theta, u, "displacement")
        if not all(load.has_potential for load in self.scene.loads):
            raise InputError(
                f"scene '{self.scene.name}': a follower pressure has no potential, so stability is "
                "not a question of its tangent's sign"
            )
        if self.scene.loaded_by:
            return bool(np.isfinite(u).all()) and self._loaded.is_stable(u, theta)
        sound = bool(np.isfinite(u).all() and self.system.least_volume_ratio(u) > 0.0)
        nothing = jnp.zeros(len(self.system.free))
        return sound and int(self.system.attempt(self.tangent(u, theta), nothing)[1]) == Outcome.OK

    def reactions(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Force (n, 3) in mN of the supports on the body at the equilibrium ``u`` (n, 3) mm.

        Springs count as supports; where the body is free the force is zero. Their sum is minus the
        resultant of the loads (:mod:`emulator.fem.reactions`).
        """
        theta, u = self._checked(theta, u, "displacement")
        return reactions(self._balanced, u, theta)

    def reaction(self, name: str, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Resultant (3,) in mN of :meth:`reactions` over the node set or facet set ``name``.

        A node that two supports share counts in both.

        Raises
        ------
        InputError
            No such set.
        """
        return _resultant(self.reactions(u, theta), nodes_of(self.scene.mesh, name))

    def equations(self, u: jax.Array, theta: jax.Array) -> tuple[Equations, ...]:
        """What the equilibrium ``u`` (n, 3) mm at ``theta`` (p,) solves.

        One set of equations; of a scene whose mesh is loaded two, of displacements whose sum is
        ``u``.
        """
        if self.scene.loaded_by:
            return self._loaded.equations(u, theta)
        residual = lambda theta, u: self.system.residual(u, theta)  # noqa: E731
        return (Equations(self.system, u, self.tangent(u, theta), residual),)

    def tangent(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Nonzeros (nnz,) of the tangent at ``u`` (n, 3) mm and ``theta`` (p,), for the system."""
        return self.system.safe_tangent(u, theta, 1.0)[0]

    def _checked(
        self, theta: jax.Array, start: jax.Array, what: str = "start"
    ) -> tuple[jax.Array, jax.Array]:
        """Both in float64. A theta of the wrong length would be read past its end, silently."""
        theta, start = jnp.asarray(theta, dtype=float), jnp.asarray(start, dtype=float)
        for name, array, shape in (
            ("theta", theta, (len(self.scene.parameters),)),
            (what, start, self.scene.held.shape),
        ):
            if array.shape != shape:
                raise InputError(
                    f"scene '{self.scene.name}': {name} has shape {array.shape}; expected {shape}"
                )
        return theta, start

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (n, 3) in mm; :class:`SolverError` when it does not converge.

        Inside ``jit`` nothing can be raised; use :meth:`solve` and its status there.
        """
        solution = self.solve(theta)
        if isinstance(solution.status, jax.core.Tracer):
            return solution.displacement
        return solution.require_converged().displacement

    @cached_property
    def _equilibrium(self) -> Found:
        return differentiable(self.system, self.options)


@jax.jit
def _resultant(forces: jax.Array, nodes: jax.Array) -> jax.Array:
    """Sum (3,) of ``forces`` (n, 3) at ``nodes``."""
    return forces[nodes].sum(axis=0)
