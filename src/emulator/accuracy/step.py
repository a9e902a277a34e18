r"""Distance of a displacement from the nearby equilibrium, by three methods.

One Newton step with a check; FEM's guarded iteration, where the check fails; and conjugate
gradients preconditioned by a tangent factorised elsewhere. :mod:`emulator.accuracy.estimate` has
the theory.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.assembly import System
from emulator.fem.compiled import while_loop
from emulator.fem.energy import volume_ratio
from emulator.fem.formulations.displacement import UNBALANCED
from emulator.fem.linear import Outcome
from emulator.fem.linear.reuse import conjugate_gradients
from emulator.fem.load_stepping import LoadStepping
from emulator.fem.simulator import Simulator
from emulator.fem.solution import Status
from emulator.fem.state import NewtonState
from emulator.scenes.scene import Scene

ENDLESS = 1e100  # mm; larger displacements count as not finite: J, their cube, would overflow
# Largest contraction of an accepted step (docs/experiments.md, "An error bar from the forces out of
# balance").
_CONTRACTION = 0.25
_SHRINK = 0.2  # least fraction of the smallest J that a step or a replacement state keeps
_ROUND_OFF = 1e-9  # errors below this fraction of the displacement are round-off: not checked
_GOOD_STEP = 0.1  # the iteration stops only after a step that leaves at most this much residual
_MOST_ITERATIONS = 30
_FRACTIONS = (1.0, 0.9, 0.75, 0.5, 0.25, 0.1, 0.0)  # of the line from centre to prediction, tried


class Distance(NamedTuple):
    """Distance of a field from equilibrium, by one of the three methods.

    move : (n, 3) mm, the field less the equilibrium.
    gap : () mN mm, the field's potential energy less the equilibrium's.
    contraction : () about the relative error of ``move``.
    iterations : () that FEM took.
    indefinite : () whether the tangent is known to be indefinite.
    settled : () whether the method's own check accepts the result.
    """

    move: jax.Array
    gap: jax.Array
    contraction: jax.Array
    iterations: jax.Array
    indefinite: jax.Array
    settled: jax.Array


def _least_J(scene: Scene, u: jax.Array) -> jax.Array:
    return jnp.min(volume_ratio(scene, u))


def _norm(field: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(field**2))


def sound_state(
    scene: Scene, centre: jax.Array, u: jax.Array, theta: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """``u`` (n, 3) and ``theta`` made safe to linearise at.

    ``u`` is put on its supports and, if an element is inverted, moved towards ``centre`` until none
    is; a theta that is not finite is replaced by the centre of the box, entry by entry.
    """
    fine = jnp.all(jnp.abs(u) < ENDLESS)
    theta = jnp.where(jnp.isfinite(theta), theta, scene.centre)
    placed = scene.on_supports(jnp.where(fine, u, centre), theta)
    fractions = jnp.array(_FRACTIONS)[:, None, None]
    states = jnp.where(fractions == 1.0, placed, centre + fractions * (placed - centre))
    J = jax.vmap(partial(_least_J, scene))(states)
    # The prediction need only have J > 0; a replacement must keep J well above 0.
    sound = (_SHRINK * J[-1] < J).at[0].set(J[0] > 0.0)
    return states[jnp.argmax(sound)], theta


def newton_distance(system: System, u: jax.Array, theta: jax.Array) -> Distance:
    """Newton's step with the opposite sign, and a check by one more back-substitution."""
    residual, _, out_of_balance = system.balance(u, theta)
    tangent = system.tangent(u, theta)
    values = system.pattern.safe_values(tangent)
    step, outcome = system.attempt(values, residual)
    move = system.extend(step)
    after = u - move
    open_ = _least_J(system.scene, after) > _SHRINK * _least_J(system.scene, u)
    left = system.residual(jnp.where(open_, after, u), theta)
    length = _norm(move)
    again = _norm(system.attempt(values, left)[0]) / jnp.where(length > 0.0, length, 1.0)
    gap = 0.5 * jnp.vdot(residual, system.restrict(move))
    sound = system.pattern.solvable(tangent) & jnp.isfinite(length) & open_ & (gap >= 0.0)
    exact = length <= _ROUND_OFF * _norm(u)
    # Strains that hardly balance any load are the error's own, and so is the stiffness they lend.
    good = (again <= _CONTRACTION) & (out_of_balance <= UNBALANCED)
    return Distance(
        move=move,
        gap=gap,
        contraction=jnp.where(exact, jnp.minimum(again, 1.0), again),
        iterations=jnp.array(0),
        indefinite=(outcome == Outcome.INDEFINITE) | (gap < 0.0),
        settled=sound & (exact | good),
    )


def guarded_distance(simulator: Simulator, u: jax.Array, theta: jax.Array) -> Distance:
    """Distance FEM's iteration travels from ``u`` until its steps are short beside it."""
    system = simulator.system
    newton = LoadStepping(system, simulator.options, theta)

    def advance(carry: tuple[NewtonState, jax.Array, jax.Array]):  # noqa: ANN202
        state, _, _ = carry
        after = newton.step(state)
        way, step = _norm(after.u - u), _norm(after.u - state.u)
        # A shortened step is small too, but leaves most of its residual.
        good = (after.relative_residual <= _GOOD_STEP * state.relative_residual) & (
            step <= _CONTRACTION * way
        )
        good &= after.load >= 1.0
        return after, good | (after.status == Status.CONVERGED), step / jnp.where(way > 0, way, 1.0)

    def unfinished(carry: tuple[NewtonState, jax.Array, jax.Array]) -> jax.Array:
        state, near, _ = carry
        going = (state.status == Status.RUNNING) & (state.load >= 1.0)
        return going & ~near & (state.iterations < _MOST_ITERATIONS)

    begun = newton.begin(u)
    at_once = begun.status == Status.CONVERGED
    state, near, ratio = while_loop(unfinished, advance, (begun, at_once, jnp.array(0.0)))
    follower = system.follower_force(u, theta)
    gap = system.potential(u, theta, 1.0, follower)[0]
    gap = gap - system.potential(state.u, theta, 1.0, follower)[0]
    return Distance(u - state.u, gap, ratio, state.iterations, jnp.array(False), near)


def gradients_distance(
    system: System, tangent: np.ndarray, iterations: int, u: jax.Array, theta: jax.Array
) -> Distance:
    """Conjugate gradients on ``K(u) e = r``, preconditioned by the centre's ``tangent`` (nnz,)."""
    values = jnp.asarray(tangent)

    def stiffness(v: jax.Array) -> jax.Array:
        along = (system.extend(v),)
        return jax.jvp(lambda w: system.residual(w, theta), (u,), along)[1]

    force = system.residual(u, theta)
    found = conjugate_gradients(
        stiffness, lambda left: system.attempt(values, left)[0], force, iterations, 0.0
    )
    return Distance(
        move=system.extend(found.x),
        gap=0.5 * jnp.vdot(force, found.x),
        contraction=found.reduction,
        iterations=jnp.array(0),
        indefinite=~found.convex,
        settled=found.convex & jnp.all(jnp.isfinite(found.x)),
    )
