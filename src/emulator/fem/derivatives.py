r"""Solutions of the discrete equations as differentiable functions of theta.

Where :math:`r(u(\theta), \theta) = 0`,

.. math::
    K\, \frac{\partial u}{\partial \theta} = -\frac{\partial r}{\partial \theta}

at the free degrees of freedom, the right-hand side with the reactions to the prescribed
displacements that theta moves. Forward derivatives are one more solve with the tangent, and reverse
ones a solve with its transpose: for a quantity :math:`q(u(\theta), \theta)`

.. math::
    \frac{dq}{d\theta} = \frac{\partial q}{\partial \theta}
        - \lambda^T \frac{\partial r}{\partial \theta}, \qquad
    K^T \lambda = \frac{\partial q}{\partial u}

whatever the number of parameters (:func:`adjoint`). A displacement may be a sum of several, each
the root of equations that depend on the displacements before it (:class:`Equations`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import zero_from_primal

from emulator.core.errors import SolverError
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled, is_traced, one_by_one
from emulator.fem.fallbacks import find_equilibrium
from emulator.fem.linear.suitesparse import on_all_cores
from emulator.fem.newton import NewtonOptions
from emulator.fem.solution import Solution
from emulator.scenes.scene import Scene

RootFinder = Callable[[System, NewtonOptions, jax.Array, jax.Array], Solution]
"""The solution of a system's equations, from its options, theta (p,) and a start (n, 3) mm."""
SolutionMap = Callable[[jax.Array, jax.Array], Solution]
"""The solution at theta (p,), sought from a start (n, 3) mm."""
Quantity = Callable[[jax.Array, jax.Array], jax.Array]
"""A number () of an equilibrium (n, 3) mm and theta (p,)."""


class Equations(NamedTuple):
    """The equations of one displacement at one theta, and their root.

    system : the system whose free degrees of freedom and linear solver the equations have.
    u : the root, (n, 3) mm.
    tangent : the nonzeros (nnz,) of the tangent at ``u``, mN/mm.
    residual : the residual (f,) in mN, a function of theta (p,), of the displacements before this
        one, and of this one.
    """

    system: System
    u: jax.Array
    tangent: jax.Array
    residual: Callable[..., jax.Array]


def equations_of(system: System, u: jax.Array, theta: jax.Array) -> Equations:
    """Return the equations of ``system`` with the root ``u`` (n, 3) mm at ``theta`` (p,)."""
    tangent = system.safe_tangent(u, theta)[0]
    return Equations(system, u, tangent, lambda theta, u: system.residual(u, theta))


def differentiable(
    system: System, options: NewtonOptions, find: RootFinder = find_equilibrium
) -> SolutionMap:
    """Return ``(theta, start) -> Solution``, whose displacement has derivatives in theta.

    The function works in Python and under ``jit``, ``vmap`` (one theta after the other) and
    ``grad``.

    system : the equations.
    options : the controls of Newton's method.
    find : the function that finds their root.
    """
    by_steps = partial(find, system, options)
    program = compiled(one_by_one(by_steps))

    def stepwise(theta: jax.Array, start: jax.Array) -> Solution:
        return (program if is_traced(theta, start) else by_steps)(theta, start)

    def derivative(u: jax.Array, theta: jax.Array, direction: jax.Array) -> jax.Array:
        tangent = system.safe_tangent(u, theta)[0]
        return derivatives_along(system, tangent, u, theta, direction[None])[0]

    return implicit(program if system.kept is None else stepwise, derivative)


def implicit(
    find: Callable[..., Solution], derivative: Callable[..., jax.Array]
) -> Callable[..., Solution]:
    """Return ``find(*parameters, start)`` with derivatives in the parameters.

    derivative : the derivative (n, 3) of a root, a function of the root (n, 3) mm, of the
        parameters, and of a direction for each of them.
    """
    solution_at = jax.custom_jvp(find)

    @solution_at.defjvp
    def rule(primals, tangents):  # noqa: ANN001, ANN202
        solution = solution_at(*primals)
        du = derivative(solution.displacement, *primals[:-1], *tangents[:-1])
        return solution, zero_from_primal(solution)._replace(displacement=du)

    return solution_at


@compiled
def derivatives_along(
    system: System, tangent: jax.Array, u: jax.Array, theta: jax.Array, directions: jax.Array
) -> jax.Array:
    """Return the derivatives (k, n, 3) of the equilibrium ``u`` along ``directions`` (k, p)."""
    equations = system.residual_on_supports(u)
    along = jax.vmap(lambda direction: jax.jvp(equations, (theta,), (direction,))[1])
    forces, prescribed = along(directions)
    return jax.vmap(system.extend, 1)(-system.solve(tangent, forces.T)) + prescribed


def sensitivities(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Return the derivatives (p, n, 3) of the equilibrium ``u`` in each entry of theta."""
    tangent, directions = system.safe_tangent(u, theta)[0], jnp.eye(len(theta))
    with on_all_cores(len(system.free)):
        return jax.block_until_ready(derivatives_along(system, tangent, u, theta, directions))


def require_finite(scene: Scene, derivatives: jax.Array, what: str) -> jax.Array:
    """Return ``derivatives``, or raise :class:`SolverError` where they are not finite numbers."""
    if not is_traced(derivatives) and not np.isfinite(derivatives).all():
        raise SolverError(f"scene '{scene.name}': {what} has no derivatives: singular tangent")
    return derivatives


def adjoint(
    system: System, quantity: Quantity
) -> Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """Return a program ``(u, theta) -> (value, gradient (p,))`` of ``quantity`` at equilibria."""

    @compiled
    def value_and_gradient(u: jax.Array, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        value, (by_u, by_theta) = jax.value_and_grad(quantity, (0, 1))(u, theta)
        tangent = system.safe_tangent(u, theta, 1.0)[0]
        slope = system.restrict(by_u)
        (multiplier,) = jax.linear_transpose(partial(system.solve, tangent), slope)(slope)
        pull_back = jax.vjp(system.residual_on_supports(u), theta)[1]
        return value, by_theta + pull_back((-multiplier, by_u))[0]

    return value_and_gradient
