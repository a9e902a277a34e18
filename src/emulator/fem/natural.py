r"""Step acceptance for Newton with mean dilatation: Deuflhard's natural monotonicity test.

The solution is a saddle point in displacements, volumes and pressures, so no energy can judge a
step, and the residual is dominated by the stiff volumes. Instead, the simplified Newton step (with
the old tangent) after a fraction of the step must be shorter than the step,

.. math::
    \left| K(x)^{-1} r(x + \alpha \Delta x) \right|
    \le \left(1 - \frac{\alpha}{4}\right) |\Delta x|

in mm (P. Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 3.3). The tangent
is factorised already, so the test costs one evaluation of the forces and one back-substitution
(docs/experiments.md, "Mean dilatation from far away: what judges a step").
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.direction import Direction
from emulator.fem.mixed import Volumes, advance, carried
from emulator.fem.programs import compiled


@compiled
def natural_monotonicity(
    system: System,
    u: jax.Array,
    volumes: Volumes,
    level: jax.Array,
    theta: jax.Array,
    direction: Direction,
    fraction: jax.Array,
) -> jax.Array:
    """Whether ``fraction`` of ``direction`` passes the test, shape ().

    Parameters
    ----------
    u, volumes, level, theta : where the step starts.
    direction : the step, with its tangent and condensed linearisation.
    """
    move, at, tangent = direction.move, direction.condensed, direction.tangent
    assert at is not None
    after = advance(system.scene, volumes, at, move, fraction)
    there = u + fraction * move
    force = system.scatter(carried(system.scene, there, after, theta, at))
    force = system.restrict(force + system.others(there, theta, level))
    left = system.extend(system.solve(tangent, -(force + (1.0 - fraction) * direction.pull)))
    left = left + (1.0 - fraction) * jnp.where(system.scene.held, move, 0.0)
    kept_open = jnp.min(after.change) > -1.0
    return kept_open & (_size(left) <= (1.0 - 0.25 * fraction) * _size(move))


def _size(field: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(field**2))
