r"""Whether a step of mean dilatation's Newton makes progress: Deuflhard's natural monotonicity.

The point sought is a saddle of displacements, volumes and pressures, so no energy tells a good step
from a bad one, and in a residual the stiff volumes drown all else. Instead, from where a fraction
of the step leads, Newton with the tangent of where it started must have less far to go,

.. math::
    \left| K(x)^{-1} r(x + \alpha \Delta x) \right|
    \le \left(1 - \frac{\alpha}{4}\right) |\Delta x|

in mm (P. Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 3.3). The factors are
there already, so this costs one evaluation of the forces and one back-substitution.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.direction import Direction
from emulator.fem.mixed import Volumes, advance, carried


def natural_monotonicity(
    system: System,
    u: jax.Array,
    volumes: Volumes,
    level: jax.Array,
    theta: jax.Array,
    direction: Direction,
) -> Callable[[jax.Array], jax.Array]:
    """``fraction -> bool``: whether that much of ``direction`` leaves less to go.

    Parameters
    ----------
    u, volumes, level, theta : where the step starts.
    direction : the step, with the tangent and the condensed linearisation it came of.
    """
    move, at, tangent = direction.move, direction.condensed, direction.tangent
    assert at is not None

    def nearer(fraction: jax.Array) -> jax.Array:
        after = advance(system.scene, volumes, at, move, fraction)
        there = u + fraction * move
        force = system.scatter(carried(system.scene, there, after, theta, at))
        force = system.restrict(force + system.others(there, theta, level))
        left = system.extend(system.solve(tangent, -(force + (1.0 - fraction) * direction.pull)))
        left = left + (1.0 - fraction) * jnp.where(system.scene.held, move, 0.0)
        kept_open = jnp.min(after.change) > -1.0
        return kept_open & (_size(left) <= (1.0 - 0.25 * fraction) * _size(move))

    return nearer


def _size(field: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(field**2))
