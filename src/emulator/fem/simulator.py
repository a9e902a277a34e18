r"""The FEM simulator: theta to displacement, differentiable through the equilibrium it solves.

At equilibrium :math:`r(u(\theta), \theta) = 0`, so

.. math::
    K\, \frac{\partial u}{\partial \theta} = -\frac{\partial r}{\partial \theta}

gives forward derivatives by one more solve with the tangent, and reverse ones by its transpose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np

from emulator._precision import require_float64
from emulator.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.driver import Driver
from emulator.fem.factorisations import REFUSALS, Choice, find_choice
from emulator.fem.factorisations.suitesparse import CHOLMOD, quiet_blas
from emulator.fem.loading_path import find_equilibrium
from emulator.fem.near import NearSolver
from emulator.fem.options import NewtonOptions
from emulator.fem.reactions import balanced, nodes_of, reactions
from emulator.fem.solution import Solution, Status
from emulator.scenes.scene import Scene
from emulator.shown import Row, Shown


@dataclass(frozen=True, eq=False, repr=False)
class Simulator(Shown):
    """Finite elements for a scene; use it alone, under ``jit``, ``vmap`` or ``grad``.

    Parameters
    ----------
    scene : what to simulate.
    options : controls of Newton's method.
    factorisation : ``umfpack`` (any tangent), ``cholmod`` (faster; raises where the tangent is
        indefinite, as it often is on the way from rest), or ``auto``: CHOLMOD where it works and
        UMFPACK where it does not, which under ``jit``, ``vmap`` and ``grad`` means UMFPACK.
        ``petsc`` (an extra) is MUMPS in both places, for meshes whose factors do not fit
        (docs/large_meshes.md).

    Raises
    ------
    InputError
        A factorisation that is unknown or not installed.
    """

    scene: Scene
    options: NewtonOptions = field(default_factory=NewtonOptions)
    factorisation: str = "auto"

    def __post_init__(self) -> None:
        find_choice(self.factorisation)
        quiet_blas()

    @property
    def _choice(self) -> Choice:
        return find_choice(self.factorisation)

    def shown(self) -> tuple[str, list[Row]]:
        """What it simulates and how."""
        unknowns = int((~self.scene.held).sum())
        _, rows = self.scene.shown()
        how = [("unknowns", str(unknowns)), ("factorisation", self.factorisation)]
        return f"Simulator of '{self.scene.name}'", [*rows, *how]

    @cached_property
    def system(self) -> System:
        """Residual and tangent of the scene."""
        return System(self.scene, self._choice.general.name)

    @cached_property
    def _driver(self) -> Driver:
        definite = self._choice.definite or CHOLMOD
        return Driver(System(self.scene, definite.name), self.system, self.options)

    @cached_property
    def _balanced(self) -> System:
        return System(balanced(self.scene))

    @property
    def rest(self) -> jax.Array:
        """The undeformed state, (n, 3)."""
        return jnp.zeros(self.scene.held.shape)

    def solve(self, theta: jax.Array, start: jax.Array | None = None) -> Solution:
        """Equilibrium at ``theta`` (p,), from ``start`` (n, 3) mm or from rest.

        A soft body may have several equilibria. The one sought is the end of the loading path from
        rest, in Python as under ``jit``, ``vmap`` and ``grad``; :mod:`emulator.fem.loading_path`
        has the strategy. An answer from ``start`` is kept if Newton's method came to it at the full
        load in a few full steps, each down the potential; otherwise ``start`` is left and the body
        is loaded from rest.

        What this cannot exclude: a ``start`` close to another equilibrium leads there in a few
        good steps, or is one already; a path that jumps where it loses stability may jump
        elsewhere with other load steps. ``NewtonOptions.load_steps`` follows the path in small
        steps, whatever the start.

        The displacement is differentiable in ``theta``. Never raises on a hard case: read
        ``status``. ``vmap`` solves one theta after the other.

        Raises
        ------
        InputError
            ``theta`` or ``start`` has the wrong shape, or float64 is off.
        """
        require_float64("FEM")
        theta, start = self._checked(theta, self.rest if start is None else start)
        try:
            solution = self._equilibrium(theta, jax.lax.stop_gradient(start))
            if not isinstance(solution.status, jax.core.Tracer):
                jax.block_until_ready(solution)
        except REFUSALS as error:
            if "singular" not in str(error):
                raise
            return self._singular()
        return solution

    def sensitivities(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Derivatives (p, n, 3) of the equilibrium ``u`` (n, 3) mm in each entry of ``theta`` (p,).

        One tangent and one factor serve them all: on a ventricle with five parameters they take a
        tenth of the time of the solve they follow. For numbers; under ``jit`` differentiate
        :meth:`solve`.

        Raises
        ------
        jax.errors.JaxRuntimeError
            A tangent singular to the last bit.
        """
        theta, u = self._checked(theta, u, "displacement")
        system, tangent = self.linearised(u, theta)
        return self._columns[system.factorisation](tangent, u, theta)

    def is_stable(self, u: jax.Array, theta: jax.Array) -> bool:
        """Whether the equilibrium ``u`` (n, 3) mm at ``theta`` (p,) is a minimum of the energy.

        Its tangent is then positive definite. At a saddle, such as a column that stays straight
        under twice its critical load, forces balance but any disturbance leads away. For numbers,
        not under ``jit``.

        Raises
        ------
        InputError
            A load without a potential: there is no energy to be least.
        """
        theta, u = self._checked(theta, u, "displacement")
        if self.system.forces:
            raise InputError(
                f"scene '{self.scene.name}': a follower pressure has no potential, so stability is "
                "not a question of its tangent's sign"
            )
        sound = bool(np.isfinite(u).all() and self.system.least_volume_ratio(u) > 0.0)
        return sound and self._driver.linearise(u, theta)[0].direct.definite

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

    def _drives(self, *arguments: jax.Array) -> bool:
        """Whether Python sees the numbers and a definite factorisation could work."""
        traced = any(isinstance(argument, jax.core.Tracer) for argument in arguments)
        return not (self._choice.definite is None or traced or self.system.forces)

    def linearised(self, u: jax.Array, theta: jax.Array) -> tuple[System, jax.Array]:
        """The system that can factorise the tangent at ``u``, and that tangent (nnz,)."""
        if self._drives(u, theta):
            return self._driver.linearise(u, theta)
        return self.system, self.system.pattern.safe_values(self.system.tangent(u, theta))

    def near(self, u: jax.Array, theta: jax.Array) -> NearSolver:
        """For solves inside ``jit`` with tangents like that at ``u`` (n, 3) mm and ``theta`` (p,).

        Both are numbers. Where that tangent is not positive definite, or no load has a potential,
        each is factorised.
        """
        theta, u = self._checked(theta, u, "displacement")
        reference = None
        if self._drives(u, theta):
            system, tangent = self._driver.linearise(u, theta)
            if system.direct.definite:
                reference = np.asarray(tangent)
        return NearSolver(self.system, self._driver.definite, reference)

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

    def _singular(self) -> Solution:
        """The result where the direct solver refuses an exactly singular tangent."""
        return Solution(
            displacement=self.rest,
            status=jnp.asarray(Status.SINGULAR_TANGENT, dtype=jnp.int64),
            iterations=jnp.asarray(0),
            factorisations=jnp.asarray(0),
            residual=jnp.asarray(jnp.inf),
            load_reached=jnp.asarray(0.0),
        )

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (n, 3) in mm; :class:`SolverError` when it does not converge.

        Inside ``jit`` nothing can be raised; use :meth:`solve` and its status there.
        """
        solution = self.solve(theta)
        if isinstance(solution.status, jax.core.Tracer):
            return solution.displacement
        return solution.require_converged().displacement

    @cached_property
    def _equilibrium(self):  # noqa: ANN202 - closures, private
        closed = jax.jit(_one_by_one(partial(find_equilibrium, self.system, self.options)))

        @jax.custom_jvp
        def equilibrium(theta: jax.Array, start: jax.Array) -> Solution:
            drives = self._drives(theta, start)
            return (self._driver.solve if drives else closed)(theta, start)

        @equilibrium.defjvp
        def derivative(primals, tangents):  # noqa: ANN001, ANN202
            theta, start = primals
            solution = equilibrium(theta, start)
            system, tangent = self.linearised(solution.displacement, theta)
            moved = self._moved[system.factorisation](
                tangent, solution.displacement, theta, tangents[0]
            )
            return solution, _inert(solution)._replace(displacement=moved)

        return equilibrium

    @cached_property
    def _systems(self) -> tuple[System, ...]:
        return (self.system,) if self._choice.definite is None else self._driver.systems

    @cached_property
    def _moved(self):  # noqa: ANN202
        return {s.factorisation: jax.jit(partial(_moved, s)) for s in self._systems}

    @cached_property
    def _columns(self):  # noqa: ANN202
        return {s.factorisation: jax.jit(partial(_columns, s)) for s in self._systems}


def _one_by_one(solve: Callable[..., Solution]) -> Callable[..., Solution]:
    """``solve`` whose ``vmap`` takes theta after theta.

    Solved side by side, every theta would take the iterations of the slowest, and each iteration
    the factorisations of all routes.
    """
    alone = jax.custom_batching.custom_vmap(solve)

    @alone.def_vmap
    def together(size, batched, theta, start):  # noqa: ANN001, ANN202
        theta, start = (
            x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
            for x, is_batched in zip((theta, start), batched, strict=True)
        )
        solutions = jax.lax.map(lambda each: alone(*each), (theta, start))
        return solutions, jax.tree.map(lambda _: True, solutions)

    return alone


def _moved(
    system: System, tangent: jax.Array, u: jax.Array, theta: jax.Array, direction: jax.Array
) -> jax.Array:
    """Derivative (n, 3) of the equilibrium ``u`` along ``direction`` (p,) in theta."""
    _, force = jax.jvp(lambda t: system.residual(u, t), (theta,), (direction,))
    return system.extend(-system.solve(tangent, force))


def _columns(system: System, tangent: jax.Array, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Derivatives (p, n, 3) of the equilibrium ``u`` along each entry of theta."""
    forces = jax.jacfwd(lambda t: system.residual(u, t))(theta)
    return jax.vmap(system.extend, in_axes=1)(-system.solve(tangent, forces))


def _inert(solution: Solution) -> Solution:
    """Zero tangents of a solution: float0 for its integers."""
    return jax.tree.map(
        lambda x: (
            jnp.zeros_like(x)
            if jnp.issubdtype(x.dtype, jnp.floating)
            else jnp.zeros(x.shape, dtype=jax.dtypes.float0)
        ),
        solution,
    )


@jax.jit
def _resultant(forces: jax.Array, nodes: jax.Array) -> jax.Array:
    """Sum (3,) of ``forces`` (n, 3) at ``nodes``."""
    return forces[nodes].sum(axis=0)
