"""The FEM simulator: the displacement as a differentiable function of theta.

ARCHITECTURE.md lists the files between a call and its equation, in reading order. Derivatives are
those of the equilibrium (:mod:`~emulator.fem.derivatives`), not of the iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.display import TableRepr
from emulator.core.engine import STAYS, Engine, engine_of
from emulator.core.errors import InputError
from emulator.core.machine import require_cpu, require_float64
from emulator.fem.assembly import System
from emulator.fem.compiled import scan
from emulator.fem.derivatives import (
    Equations,
    Quantity,
    SolutionMap,
    adjoint,
    differentiable,
    equations_of,
    require_finite,
    sensitivities,
)
from emulator.fem.energy import require_shape
from emulator.fem.linear.suitesparse import prepare
from emulator.fem.loaded import LoadedEquilibrium
from emulator.fem.newton import NewtonOptions
from emulator.fem.reactions import balanced, nodes_of, reactions
from emulator.fem.solution import Solution
from emulator.scenes.scene import Scene, with_mesh


@dataclass(frozen=True, eq=False, repr=False)
class Simulator(TableRepr):
    """Simulates a scene by finite elements, alone or under ``jit``, ``vmap`` or ``grad``.

    Parameters
    ----------
    scene : the scene to simulate.
    options : the controls of Newton's method.
    executor : the executor of :mod:`concurrent.futures` that does many solves, or words:
        ``processes:4``, ``dask:ADDRESS`` (:mod:`emulator.core.engine`); by default threads.

    Raises
    ------
    InputError
        A specimen, a version of JAX that SuiteSparse cannot be called from, or JAX's default device
        is no CPU.
    """

    scene: Scene
    options: NewtonOptions = field(default_factory=NewtonOptions)
    executor: Executor | str | None = field(default=None, metadata={STAYS: True})

    sent_once = True

    def __post_init__(self) -> None:
        with_mesh(self.scene)
        require_cpu("FEM")
        prepare()
        if self.scene.loaded_by:
            self._loaded.unloader  # noqa: B018 - raises for scenes that cannot be unloaded

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return the title and the rows of the printed summary."""
        unknowns = int((~self.scene.held).sum())
        _, rows = self.scene.summary_rows()
        return f"Simulator of '{self.scene.name}'", [*rows, ("unknowns", str(unknowns))]

    @cached_property
    def engine(self) -> Engine | None:
        """The engine that does many solves; None for threads of this process."""
        return engine_of(self.executor)

    @cached_property
    def system(self) -> System:
        """The discrete equations of the scene."""
        return System(self.scene)

    @cached_property
    def _balanced(self) -> System:
        return System(balanced(self.scene))

    @cached_property
    def _loaded(self) -> LoadedEquilibrium:
        return LoadedEquilibrium(self.scene, self.options)

    @property
    def stepwise(self) -> bool:
        """Solves from Python go step by step where a factor is kept."""
        return not self.scene.loaded_by and self.system.kept is not None

    @property
    def rest(self) -> jax.Array:
        """The undeformed state, (n, 3)."""
        return jnp.zeros(self.scene.held.shape)

    def solve(self, theta: jax.Array, start: jax.Array | None = None) -> Solution:
        """Return the equilibrium at ``theta`` (p,), sought from ``start`` (n, 3) mm or from rest.

        A soft body may have several equilibria. The one sought is the end of the loading path from
        rest, in Python as under ``jit``, ``vmap`` and ``grad`` (:mod:`emulator.fem.fallbacks`). The
        solution from ``start`` is accepted if Newton's method reached it at the full load in a few
        full steps, each down the potential; otherwise the body is loaded from rest.

        This does not exclude every other equilibrium: a ``start`` close to one leads there in a few
        good steps, or is one already; and a path that jumps where it loses stability may jump
        elsewhere with other load steps. ``NewtonOptions.load_steps`` follows the path in small
        steps, whatever the start.

        If the scene's mesh is its shape under load, the displacement is measured from the mesh, and
        the stress-free shape is found first (:mod:`emulator.fem.loaded`).

        The displacement is differentiable in ``theta``. A failure is no exception: read ``status``.
        ``vmap`` solves one theta after the other.

        Raises
        ------
        InputError
            ``theta`` or ``start`` has the wrong shape, or float64 is off.
        """
        require_float64("FEM")
        theta, u = self._check_state(theta, self.rest if start is None else start)
        if self.scene.loaded_by:
            return self._loaded.solve(theta, None if start is None else u)
        return jax.block_until_ready(self._equilibrium(theta, jax.lax.stop_gradient(u)))

    def path(self, thetas: jax.Array) -> Solution:
        """Return the equilibria along a path of theta (m, p), such as a loading curve.

        Fields of the solution gain an axis m. Each equilibrium is sought from the extrapolation of
        the two before it, and the first one (and one after a body at rest) from rest: a curve of
        many points costs a few iterations a point. Differentiable as :meth:`solve` is. One
        with viscosity goes through the times in theta (:mod:`emulator.fem.through_time`).

        Raises
        ------
        InputError
            ``thetas`` has the wrong shape, its times fall, or float64 is off.
        """
        thetas = jnp.asarray(thetas, dtype=float)
        if thetas.ndim != 2 or not len(thetas) or thetas.shape[1] != len(self.scene.parameters):
            raise InputError(
                f"scene '{self.scene.name}': path has shape {thetas.shape}; expected "
                f"(m, {len(self.scene.parameters)})"
            )
        if self.scene.in_time:
            through_time = import_module("emulator.fem.through_time").through_time  # a room
            return cast(Solution, through_time(self.scene, self.options, thetas))

        def next_point(
            last_two: tuple[jax.Array, jax.Array], theta: jax.Array
        ) -> tuple[tuple[jax.Array, jax.Array], Solution]:
            u, u_before = last_two
            extrapolation = self.scene.on_supports(2.0 * u - u_before, theta)
            # From rest the start stays at rest: supports that jump alone would invert elements.
            solution = self.solve(theta, jnp.where(jnp.any(u != 0.0), extrapolation, self.rest))
            return (solution.displacement, u), solution

        solutions: Solution = scan(next_point, (self.rest, self.rest), thetas)[1]
        return solutions

    def sensitivities(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the derivatives (p, n, 3) of the equilibrium ``u`` (n, 3) mm in ``theta`` (p,).

        One tangent and one factor serve all parameters: on a ventricle with five of them they take
        a tenth of the time of the solve. For numbers; under ``jit`` differentiate :meth:`solve`.
        For a force or a volume alone, :meth:`gradient_of` is cheaper.

        Raises
        ------
        SolverError
            The tangent is singular.
        """
        theta, u = self._check_state(theta, u, "displacement")
        if self.scene.loaded_by:
            rows = self._loaded.sensitivities(u, theta)
        else:
            rows = sensitivities(self.system, u, theta)
        return require_finite(self.scene, rows, "the equilibrium")

    def gradient_of(
        self, quantity: Quantity
    ) -> Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        """Return a program for the value and the gradient in theta of a quantity of equilibria.

        ``quantity(u, theta)`` is a number () of displacements (n, 3) mm and theta (p,), such as
        the force of a support. The program takes an equilibrium (n, 3) mm and its theta (p,), and
        returns the number and its gradient (p,): one more solve with the tangent, however many
        parameters there are. Keep the program: each call of this method compiles one. For numbers;
        NaN where the tangent is singular.
        """
        if not self.scene.loaded_by:
            return adjoint(self.system, quantity)
        partial_gradients = jax.jit(jax.value_and_grad(quantity, (0, 1)))

        def value_and_gradient(u: jax.Array, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
            value, (by_u, by_theta) = partial_gradients(u, theta)
            return value, by_theta + jnp.tensordot(self.sensitivities(u, theta), by_u, 2)

        return value_and_gradient

    def is_stable(self, u: jax.Array, theta: jax.Array) -> bool:
        """Return whether the equilibrium ``u`` (n, 3) mm at ``theta`` is a minimum of the energy.

        Its tangent is then positive definite. At a saddle, such as a column that stays straight
        under twice its critical load, forces balance but any disturbance leads away. If the scene's
        mesh is loaded, the body is loaded from its stress-free shape. For numbers, not under
        ``jit``.

        Raises
        ------
        InputError
            A load has no potential, so that there is no energy to be least.
        """
        theta, u = self._check_state(theta, u, "displacement")
        if not all(load.has_potential for load in self.scene.loads):
            raise InputError(
                f"scene '{self.scene.name}': a follower pressure has no potential, so stability is "
                "not a question of its tangent's sign"
            )
        if self.scene.loaded_by:
            return bool(np.isfinite(u).all()) and self._loaded.is_stable(u, theta)
        if not (np.isfinite(u).all() and self.system.least_volume_ratio(u) > 0.0):
            return False
        return self.system.is_definite(self.tangent(u, theta))

    def reactions(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the force (n, 3) in mN of the supports on the body at the equilibrium ``u``.

        Springs count as supports; where the body is free the force is zero. Their sum is minus the
        resultant of the loads (:mod:`emulator.fem.reactions`).
        """
        theta, u = self._check_state(theta, u, "displacement")
        return reactions(self._balanced, u, theta)

    def reaction(self, name: str, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the resultant (3,) in mN of :meth:`reactions` over the set ``name``.

        ``name`` is a node set or a facet set. A node that two supports share counts in both.

        Raises
        ------
        InputError
            The mesh has no set of this name.
        """
        return self.reactions(u, theta)[nodes_of(self.scene.mesh, name)].sum(axis=0)

    def equations(self, u: jax.Array, theta: jax.Array) -> tuple[Equations, ...]:
        """Return the equations whose root is the equilibrium ``u`` (n, 3) mm at ``theta`` (p,).

        A scene whose mesh is loaded has two, of displacements whose sum is ``u``; others have one.
        """
        if self.scene.loaded_by:
            return self._loaded.equations(u, theta)
        return (equations_of(self.system, u, theta),)

    def tangent(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the nonzeros (nnz,) of the tangent at ``u`` (n, 3) mm and ``theta`` (p,)."""
        return self.system.safe_tangent(u, theta, 1.0)[0]

    def _check_state(
        self, theta: jax.Array, start: jax.Array, what: str = "start"
    ) -> tuple[jax.Array, jax.Array]:
        """Return both in float64; a short theta would be read past its end without an error."""
        theta, start = jnp.asarray(theta, dtype=float), jnp.asarray(start, dtype=float)
        require_shape(self.scene, "theta", theta, (len(self.scene.parameters),))
        require_shape(self.scene, what, start, self.scene.held.shape)
        return theta, start

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (n, 3) in mm; :class:`SolverError` when it does not converge.

        Inside ``jit`` nothing can be raised; use :meth:`solve` and its status there.
        """
        solution = self.solve(theta)
        if isinstance(solution.status, jax.core.Tracer):
            return solution.displacement
        return solution.require_converged().displacement

    @cached_property
    def _equilibrium(self) -> SolutionMap:
        return differentiable(self.system, self.options)
