r"""Line search: how much of a Newton step to take.

The largest :math:`\alpha \in \{1, \tfrac12, \tfrac14, \dots\}` that keeps every element's
:math:`J` above a fraction of its present least value and, once the supports are met, lowers the
potential energy by Armijo's rule. Exponential laws diverge without it (docs/experiments.md,
"Newton's steps: guard J only, or ask for descent").

The loops carry their verdicts as state, so that their conditions read a flag: under ``vmap`` a
condition that evaluates the potential itself never returned on a ventricle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.balance import balance
from emulator.fem.halving import ARMIJO, Judge, falls_enough, largest_good
from emulator.fem.loop import while_loop
from emulator.fem.newton.direction import Direction
from emulator.fem.system import System

_LEAST_FRACTION = 2.0**-19
# Natural monotonicity fails early: a lower load is cheaper than many short steps
# (docs/experiments.md, "Mean dilatation from far away").
_LEAST_NATURAL = 2.0**-6
# Least fraction that is halved because the potential falls further; below, the search has found a
# valley (docs/experiments.md, "Fewer factorisations from rest").
_SMALLEST_HALVED = 0.02


class _Valley(NamedTuple):
    """A fraction of the step, its potential, and whether half of it may be lower."""

    fraction: jax.Array
    energy: jax.Array
    falls: jax.Array


def choose_fraction(
    system: System,
    u: jax.Array,
    level: jax.Array,
    theta: jax.Array,
    direction: Direction,
    shrink: float,
    nearer: Callable[[jax.Array], jax.Array] | None = None,
) -> tuple[jax.Array, jax.Array]:
    """How much of the step to take, among 1, 1/2, 1/4, ...; 0 where no part of it will do.

    The largest that makes progress, halved on while that lowers the potential further: a soft
    start overshoots, and from there the tangent is indefinite and the way back long.

    Parameters
    ----------
    u : (n, 3) mm, where the step starts. level : fraction of the load. theta : (p,).
    shrink : least fraction of the present smallest ``J`` that the step may leave.
    nearer : judges a fraction in place of the potential, for mean dilatation, which has none.

    Returns
    -------
    The fraction, and whether it was crushed elements that forbade twice as much.
    """
    floor = shrink * system.least_volume_ratio(u)
    follower = system.follower_force(u, theta)

    def potential(fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
        return system.potential(u + fraction * direction.move, theta, level, follower)

    def sound(fraction: jax.Array) -> jax.Array:
        J = system.least_volume_ratio(u + fraction * direction.move)
        return floor < J  # False for NaN

    if nearer is not None:
        trial = largest_good(sound, lambda f: (nearer(f), jnp.zeros(())), _LEAST_NATURAL)
        return jnp.where(trial.good, trial.fraction, 0.0), trial.crushed
    progress = _progress(system, u, level, theta, direction, potential)
    trial = largest_good(sound, progress, _LEAST_FRACTION)
    begin = _Valley(trial.fraction, trial.energy, direction.settled & trial.good)
    fraction = _lowest(lambda f: potential(f)[0], begin)
    return jnp.where(trial.good, fraction, 0.0), trial.crushed


def _lowest(potential: Callable[[jax.Array], jax.Array], begin: _Valley) -> jax.Array:
    """The fraction halved as long as that lowers the potential."""

    def halve(at: _Valley) -> _Valley:
        half = 0.5 * at.fraction
        energy = potential(half)
        lower = energy < at.energy
        fraction = jnp.where(lower, half, at.fraction)
        return _Valley(fraction, jnp.where(lower, energy, at.energy), lower)

    def wanted(at: _Valley) -> jax.Array:
        return at.falls & (at.fraction > _SMALLEST_HALVED)

    return while_loop(wanted, halve, begin).fraction


def _progress(
    system: System,
    u: jax.Array,
    level: jax.Array,
    theta: jax.Array,
    direction: Direction,
    potential: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
) -> Judge:
    """Whether a fraction of the step makes progress, besides crushing no element."""
    descent = jnp.where(direction.settled, -ARMIJO * jnp.abs(direction.slope), jnp.inf)
    falls = falls_enough(potential, descent)

    def judge(fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
        lower, found = falls(fraction)
        if system.forces:
            left = balance(system, u + fraction * direction.move, theta, level)[0]
            before = jnp.sum(direction.equations.residual**2)
            lower |= jnp.sum(left**2) < (1.0 - ARMIJO * fraction) * before
        return lower, found

    return judge
