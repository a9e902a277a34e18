r"""Solutions of a system as functions of theta, differentiable through their equations.

Where :math:`r(u(\theta), \theta) = 0`,

.. math::
    K\, \frac{\partial u}{\partial \theta} = -\frac{\partial r}{\partial \theta}

(where free; the derivative of r has what the supports pull, where theta moves them)
gives forward derivatives by one more solve with the tangent, and reverse ones by its transpose:
of a quantity :math:`q(u(\theta), \theta)`

.. math::
    \frac{dq}{d\theta} = \frac{\partial q}{\partial \theta}
        - \lambda^T \frac{\partial r}{\partial \theta}, \qquad
    K^T \lambda = \frac{\partial q}{\partial u}

whatever the number of parameters (:func:`adjoint`).
A displacement may be a sum of several, each the root of equations that depend on those before
(:class:`Equations`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.continuation import find_equilibrium
from emulator.fem.loop import compiled, jit, one_by_one
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Solution
from emulator.fem.system import System

Find = Callable[[System, NewtonOptions, jax.Array, jax.Array], Solution]
Found = Callable[[jax.Array, jax.Array], Solution]
Quantity = Callable[[jax.Array, jax.Array], jax.Array]
"""A number () of an equilibrium (n, 3) mm and theta (p,)."""


class Equations(NamedTuple):
    """Equations of one displacement at one theta, and its root.

    system : its free degrees of freedom, and what solves with the tangent.
    u : (n, 3) mm, the root. tangent : (nnz,) there.
    residual : (f,) mN, of theta (p,), of the displacements before, and of this one.
    """

    system: System
    u: jax.Array
    tangent: jax.Array
    residual: Callable[..., jax.Array]


def differentiable(
    system: System, options: NewtonOptions, solver: Find = find_equilibrium
) -> Found:
    """``(theta, start) -> Solution`` of ``system``; its displacement differentiates in theta.

    In Python as under ``jit``, ``vmap`` (one theta after the other) and ``grad``. ``solver`` finds
    the root.
    """
    find = partial(solver, system, options)
    alone = one_by_one(find)

    @jit
    def closed(theta: jax.Array, start: jax.Array) -> Solution:
        return alone(theta, start)

    @jax.custom_jvp
    def solution_at(theta: jax.Array, start: jax.Array) -> Solution:
        traced = any(isinstance(x, jax.core.Tracer) for x in (theta, start))
        stepwise = system.stepwise and not traced
        found = (find if stepwise else closed)(theta, start)
        return found if traced else jax.block_until_ready(found)

    @solution_at.defjvp
    def derivative(primals, tangents):  # noqa: ANN001, ANN202
        theta, start = primals
        solution = solution_at(theta, start)
        u = solution.displacement
        tangent = system.safe_tangent(u, theta, 1.0)[0]
        moved = _moved(system, tangent, u, theta, tangents[0])
        return solution, inert(solution)._replace(displacement=moved)

    return solution_at


@compiled
def _moved(
    system: System, tangent: jax.Array, u: jax.Array, theta: jax.Array, direction: jax.Array
) -> jax.Array:
    """Derivative (n, 3) of the equilibrium ``u`` along ``direction`` (p,) in theta."""
    _, (force, held) = jax.jvp(system.moved_supports(u), (theta,), (direction,))
    return held + system.extend(-system.solve(tangent, force))


@compiled
def derivatives(system: System, tangent: jax.Array, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Derivatives (p, n, 3) of the equilibrium ``u`` along each entry of theta."""
    forces, held = jax.jacfwd(system.moved_supports(u))(theta)
    moved = jax.vmap(system.extend, in_axes=1)(-system.solve(tangent, forces))
    return moved + jnp.moveaxis(held, -1, 0)


def adjoint(
    system: System, quantity: Quantity
) -> Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """``(u, theta) -> (value, gradient (p,))`` of ``quantity`` at equilibria, one program."""

    @jit
    def along_theta(u: jax.Array, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        value, (by_u, by_theta) = jax.value_and_grad(quantity, (0, 1))(u, theta)
        tangent = system.safe_tangent(u, theta, 1.0)[0]
        wanted = system.restrict(by_u)
        (weights,) = jax.linear_transpose(partial(system.solve, tangent), wanted)(wanted)
        back = jax.vjp(system.moved_supports(u), theta)[1]
        return value, by_theta + back((-weights, by_u))[0]

    return along_theta


def inert(solution: Solution) -> Solution:
    """Zero tangents of a solution: float0 for its integers."""
    return jax.tree.map(
        lambda x: (
            jnp.zeros_like(x)
            if jnp.issubdtype(x.dtype, jnp.floating)
            else jnp.zeros(x.shape, dtype=jax.dtypes.float0)
        ),
        solution,
    )
