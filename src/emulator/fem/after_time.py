"""What follows from the motion of a body in time: its derivatives, and the forces of supports.

The past of each step follows from the displacements before it, so nothing is solved again but one
linear system a step for the derivatives.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled
from emulator.fem.derivatives import derivatives_along
from emulator.fem.reactions import SupportForce
from emulator.fem.through_time import Past, after_step, at_rest, before_step, system_of
from emulator.scenes.scene import Scene
from emulator.viscosity.times import TIME

ForceThroughTime = Callable[[jax.Array, jax.Array], jax.Array]
"""The forces (m,) in mN of displacements (m, n, 3) mm and thetas (m, p), from rest on."""


def slopes_through_time(
    scene: Scene, u: jax.Array, thetas: jax.Array, directions: jax.Array
) -> jax.Array:
    """Return the derivatives (k, m, n, 3) of equilibria along directions that all times share.

    They are found step by step, by one tangent for all directions. Under ``jit`` differentiate
    :func:`~emulator.fem.through_time.through_time`.

    Parameters
    ----------
    u : the equilibria, (m, n, 3) mm.
    thetas : theta at each time, (m, p).
    directions : the directions in theta, (k, p).
    """
    system, past = system_of(scene), at_rest(scene)
    along = jax.tree.map(lambda field: jnp.zeros((len(directions), *field.shape)), past)
    intervals = jnp.diff(thetas[:, scene.parameter_names.index(TIME)], prepend=0.0)
    slopes = list[jax.Array]()
    for row, theta, interval in zip(u, thetas, intervals, strict=True):
        whole, change = _before_step_along(system, past, theta, interval, along, directions)
        tangent = system.safe_tangent(row, whole)[0]
        slopes.append(derivatives_along(system, tangent, row, whole, change))
        past, along = _after_step_along(
            system, past, row, whole, interval, along, slopes[-1], change
        )
    return jnp.stack(slopes, axis=1)


@compiled
def _before_step_along(
    system: System,
    past: Past,
    theta: jax.Array,
    interval: jax.Array,
    along: Past,
    directions: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Return :func:`before_step`, and its derivatives along (k, ...) the past's and theta's."""

    def before(past: Past, theta: jax.Array) -> jax.Array:
        return before_step(system, past, theta, interval)

    derivative = jax.vmap(lambda *change: jax.jvp(before, (past, theta), change)[1])
    return before(past, theta), derivative(along, directions)


@compiled
def _after_step_along(
    system: System,
    past: Past,
    u: jax.Array,
    theta: jax.Array,
    interval: jax.Array,
    along: Past,
    du: jax.Array,
    dtheta: jax.Array,
) -> tuple[Past, Past]:
    """Return :func:`after_step`, and its derivatives along those of its arguments, (k, ...)."""

    def after(past: Past, u: jax.Array, theta: jax.Array) -> Past:
        return after_step(system, past, u, theta, interval)

    derivative = jax.vmap(lambda *change: jax.jvp(after, (past, u, theta), change)[1])
    return after(past, u, theta), derivative(along, du, dtheta)


def force_through_time(scene: Scene, force: SupportForce) -> ForceThroughTime:
    """Return the force in mN of a support of a body in time, as a function of where it has been.

    The force of a grip balances what the step's tissue, mass and loads do there, and the force of
    springs does not depend on the past.

    force : the force of the support on the body at rest.

    :class:`InputError` for a support by springs at some displacements and held at others.
    """
    held, sprung = force.acts_by
    if held and sprung:
        raise InputError(
            f"force of support '{force.name}': a part of it is held and a part is on springs; in "
            "time give a direction or a set of one of them"
        )
    if sprung:
        return lambda u, thetas: force(u[:, force.nodes], thetas)
    system = system_of(scene)
    of_step = SupportForce(system.scene, force.name, force.direction, springs=False)

    def forces(u: jax.Array, thetas: jax.Array) -> jax.Array:
        def step(past: Past, row: tuple[jax.Array, ...]) -> tuple[Past, jax.Array]:
            displacement, theta, interval = row
            whole = before_step(system, past, theta, interval)
            value = of_step(displacement[of_step.nodes], whole)
            return after_step(system, past, displacement, whole, interval), value

        times = thetas[:, scene.parameter_names.index(TIME)]
        rows = (u, thetas, jnp.diff(times, prepend=0.0))
        return jax.lax.scan(step, at_rest(scene), rows)[1]

    return forces
