"""How much of a Newton step to take."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.functional import volume_ratio

_LEAST_FRACTION = 2.0**-20
_LEAST_NATURAL = 2.0**-7  # natural monotonicity fails early: a lower load is cheaper
_ARMIJO = 1e-4
_SMALLEST_HALVED = 0.02
_ROUND_OFF = 1e-13


class Direction(NamedTuple):
    """Newton's full step, and what judges how much of it to take."""

    move: jax.Array  # (n, 3) mm
    residual: jax.Array  # (f,) mN where it starts
    pull: jax.Array  # (f,) mN, what moving the supports adds to it
    slope: jax.Array  # residual . move before it was turned round, mN mm
    settled: jax.Array  # whether the supports are where they belong
    singular: jax.Array  # whether its tangent was


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
    floor = shrink * jnp.min(volume_ratio(system.scene, u))
    follower = system.follower_force(u, theta)

    def potential(fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
        return system.potential(u + fraction * direction.move, theta, level, follower)

    def sound(fraction: jax.Array) -> jax.Array:
        J = volume_ratio(system.scene, u + fraction * direction.move)
        return jnp.min(J) > floor  # False for NaN

    def halve(fraction: jax.Array) -> jax.Array:
        return 0.5 * fraction

    least = _LEAST_FRACTION if nearer is None else _LEAST_NATURAL
    lowers = _progress(system, u, level, theta, direction, potential) if nearer is None else nearer
    fraction = jax.lax.while_loop(
        lambda f: (f > least) & ~(sound(f) & lowers(f)), halve, jnp.array(1.0)
    )
    found = fraction > least
    crushed = (fraction < 1.0) & ~sound(2.0 * fraction)
    if nearer is not None:
        return jnp.where(found, fraction, 0.0), crushed
    fraction = jax.lax.while_loop(
        lambda f: (
            direction.settled & (f > _SMALLEST_HALVED) & (potential(halve(f))[0] < potential(f)[0])
        ),
        halve,
        fraction,
    )
    return jnp.where(found, fraction, 0.0), crushed


def _progress(
    system: System,
    u: jax.Array,
    level: jax.Array,
    theta: jax.Array,
    direction: Direction,
    potential: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
) -> Callable[[jax.Array], jax.Array]:
    """Whether a fraction of the step makes progress, besides crushing no element."""
    energy, size = potential(jnp.array(0.0))
    # Near the solution the decrease drowns in the round-off of the energy's parts.
    ceiling = energy + _ROUND_OFF * size
    descent = jnp.where(direction.settled, -_ARMIJO * jnp.abs(direction.slope), jnp.inf)

    def lowers(fraction: jax.Array) -> jax.Array:
        lower = potential(fraction)[0] <= ceiling + fraction * descent
        if system.forces:
            left = system.residual(u + fraction * direction.move, theta, level)
            before = jnp.sum(direction.residual**2)
            lower |= jnp.sum(left**2) < (1.0 - _ARMIJO * fraction) * before
        return lower

    return lowers
