r"""Minimise a smooth function of a few unknowns by damped Newton steps.

At x with value f, slope :math:`g = \nabla f` and Hessian K the step is

.. math:: p = -\hat K^{-1} g

with K or, where K is not positive definite, K with a larger diagonal
(:mod:`emulator.core.small_matrices`), so that :math:`g^T p < 0`. The fraction
:math:`\alpha \le 1` of the step leaves a fifth of each distance to the lower bounds l,
:math:`x + \alpha p - l \ge (x - l) / 5`, and is halved until f is finite and decreases enough,

.. math:: f(x + \alpha p) \le f(x) + 10^{-4} \alpha\, g^T p

(Armijo's condition; Nocedal and Wright 2006, Sections 3.1 and 19.2). Steps so short that round-off
in f hides the decrease are accepted. The search ends at a step below the tolerance, whose
successor would be about its square. A minimum on a bound is not reached: the bounds are open.

It is written for one problem; ``jax.vmap`` solves many, each to its own end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.core.small_matrices import solve_modified

_EVALUATIONS = 300  # an exponential law's exponent falls by about 1 in each, far away
_HIDDEN = 1e-6  # step whose decrease of the function may be less than round-off
_ARMIJO = 1e-4
_LEAST = 0.2  # share of the distance to a bound that a step leaves

Quadratic = Callable[[jax.Array], tuple[jax.Array, jax.Array, jax.Array]]
"""A point (u,) to the value (), the slope (u,) and the Hessian (u, u) there."""


class NewtonMinimum(NamedTuple):
    """A minimum of a function of a few unknowns.

    x : the point (u,); the start where the search did not converge.
    hessian : the Hessian (u, u) at the last step's base; the identity where it did not converge.
    converged : whether the last step was shorter than the tolerance.
    """

    x: jax.Array
    hessian: jax.Array
    converged: jax.Array


class _Search(NamedTuple):
    """A trial point x (u,): ``base`` (u,) and a ``fraction`` of the step (u,) from there.

    value, rate : the function at the base, and its derivative along the whole step.
    hessian : the Hessian (u, u) at the base.
    evaluations : the number of points at which the function was evaluated.
    """

    x: jax.Array
    base: jax.Array
    step: jax.Array
    fraction: jax.Array
    value: jax.Array
    rate: jax.Array
    hessian: jax.Array
    evaluations: jax.Array


def minimise_by_newton(
    quadratic: Quadratic,
    start: jax.Array,
    *,
    low: jax.Array | float = -jnp.inf,
    tolerance: float = 1e-9,
) -> NewtonMinimum:
    """Return the minimum that damped Newton steps descend to from ``start`` (u,).

    quadratic : value, slope and Hessian at a point; any may be infinite or NaN away from the start.
    low : lower bounds that no step reaches, () or (u,).
    tolerance : the step below which the search ends; unknowns are of order 1.
    """

    def advance(search: _Search) -> _Search:
        value, slope, hessian = quadratic(search.x)
        lower = value <= search.value + _ARMIJO * search.fraction * search.rate
        accepted = jnp.isfinite(value) & (lower | (jnp.max(jnp.abs(search.step)) < _HIDDEN))
        step = -solve_modified(hessian, slope)
        falling = step < 0.0
        most = (1.0 - _LEAST) * (search.x - low) / jnp.where(falling, -step, jnp.inf)
        fraction = jnp.minimum(1.0, jnp.min(jnp.where(falling, most, 1.0)))
        onward = _Search(
            x=search.x + fraction * step,
            base=search.x,
            step=step,
            fraction=fraction,
            value=value,
            rate=jnp.vdot(slope, step),
            hessian=hessian,
            evaluations=search.evaluations,
        )
        half = 0.5 * search.fraction
        back = search._replace(x=search.base + half * search.step, fraction=half)
        chosen = jax.tree.map(lambda yes, no: jnp.where(accepted, yes, no), onward, back)
        return chosen._replace(evaluations=search.evaluations + 1)

    def unfinished(search: _Search) -> jax.Array:
        long = jnp.max(jnp.abs(search.step)) > tolerance
        return long & (search.evaluations < _EVALUATIONS)

    size, zero = len(start), jnp.zeros(())
    begin = _Search(
        x=start,
        base=start,
        step=jnp.full(size, jnp.inf),
        fraction=zero,
        value=jnp.array(jnp.inf),
        rate=zero,
        hessian=jnp.eye(size),
        evaluations=jnp.array(0),
    )
    end = jax.lax.while_loop(unfinished, advance, begin)
    converged = (jnp.max(jnp.abs(end.step)) <= tolerance) & jnp.all(jnp.isfinite(end.x))
    hessian = jnp.where(converged, end.hessian, jnp.eye(size))
    return NewtonMinimum(jnp.where(converged, end.x, start), hessian, converged)
