"""The distance of a displacement from the nearby equilibrium, by two methods.

One Newton step with a check, and FEM's guarded iteration, where the check fails.
:mod:`emulator.accuracy.estimate` has the theory.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.compiled import while_loop
from emulator.fem.energy import volume_ratio
from emulator.fem.formulations.displacement import UNBALANCED
from emulator.fem.linear import Outcome
from emulator.fem.load_stepping import LoadStepping
from emulator.fem.simulator import Simulator
from emulator.fem.solution import NewtonState, Status
from emulator.scenes.scene import Scene

LARGEST_U = 1e100  # mm; larger displacements count as not finite: J, their cube, would overflow
# Largest contraction of an accepted step (docs/experiments.md, "An error bar from the forces out of
# balance").
_CONTRACTION = 0.25
_LEAST_SHARE = 0.2  # least share of the smallest J after a step or in a replacement state
_ROUND_OFF = 1e-9  # errors below this fraction of the displacement are round-off: not checked
_GOOD_STEP = 0.1  # the iteration stops only after a step that leaves at most this much residual
_MOST_ITERATIONS = 30
_FRACTIONS = (
    1.0,
    0.9,
    0.75,
    0.5,
    0.25,
    0.1,
    0.0,
)  # along the line from the centre's solution


class Distance(NamedTuple):
    """The distance of a field from equilibrium, by one of the two methods.

    error : the field less the equilibrium, (n, 3) mm.
    gap : the field's potential energy less the equilibrium's, () mN mm.
    contraction : the estimated relative error of ``error``, ().
    iterations : the number of FEM iterations, ().
    indefinite : whether the tangent is known to be indefinite, ().
    accepted : whether the method's own check accepts the result, ().
    """

    error: jax.Array
    gap: jax.Array
    contraction: jax.Array
    iterations: jax.Array
    indefinite: jax.Array
    accepted: jax.Array


def _least_J(scene: Scene, u: jax.Array) -> jax.Array:
    return jnp.min(volume_ratio(scene, u))


def _norm(field: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(field**2))


def valid_state(
    scene: Scene, centre: jax.Array, u: jax.Array, theta: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return ``u`` (n, 3) and ``theta`` (p,), changed where the energy has no tangent.

    ``u`` is put on its supports and, if an element is inverted, moved towards ``centre``, the
    solution (n, 3) at the centre of the box, until none is. Entries of theta that are not finite
    are replaced by the centre's.
    """
    finite = jnp.all(jnp.abs(u) < LARGEST_U)
    theta = jnp.where(jnp.isfinite(theta), theta, scene.centre)
    supported = scene.on_supports(jnp.where(finite, u, centre), theta)
    fractions = jnp.array(_FRACTIONS)[:, None, None]
    states = jnp.where(fractions == 1.0, supported, centre + fractions * (supported - centre))
    J = jax.vmap(partial(_least_J, scene))(states)
    # The prediction need only have J > 0; a replacement must keep J well above 0.
    valid = (_LEAST_SHARE * J[-1] < J).at[0].set(J[0] > 0.0)
    return states[jnp.argmax(valid)], theta


def newton_distance(system: System, u: jax.Array, theta: jax.Array) -> Distance:
    """Take Newton's step with the opposite sign, and check it by one more back-substitution."""
    residual, _, relative = system.balance(u, theta)
    tangent = system.tangent(u, theta)
    values = system.pattern.safe_values(tangent)
    step, outcome = system.attempt(values, residual)
    error = system.extend(step)
    corrected = u - error
    upright = _least_J(system.scene, corrected) > _LEAST_SHARE * _least_J(system.scene, u)
    remainder = system.residual(jnp.where(upright, corrected, u), theta)
    length = _norm(error)
    contraction = _norm(system.attempt(values, remainder)[0]) / jnp.where(length > 0, length, 1.0)
    gap = 0.5 * jnp.vdot(residual, system.restrict(error))
    valid = system.pattern.solvable(tangent) & jnp.isfinite(length) & upright & (gap >= 0.0)
    exact = length <= _ROUND_OFF * _norm(u)
    # Strains that hardly balance any load are due to the error, and so is their stiffness.
    contracts = (contraction <= _CONTRACTION) & (relative <= UNBALANCED)
    return Distance(
        error=error,
        gap=gap,
        contraction=jnp.where(exact, jnp.minimum(contraction, 1.0), contraction),
        iterations=jnp.array(0),
        indefinite=(outcome == Outcome.INDEFINITE) | (gap < 0.0),
        accepted=valid & (exact | contracts),
    )


def guarded_distance(simulator: Simulator, u: jax.Array, theta: jax.Array) -> Distance:
    """Iterate by FEM from ``u`` until steps are short beside the distance covered; return it."""
    system = simulator.system
    stepping = LoadStepping(system, simulator.options, theta)

    def advance(carry: tuple[NewtonState, jax.Array, jax.Array]):  # noqa: ANN202
        state, _, _ = carry
        next_state = stepping.step(state)
        way, step = _norm(next_state.u - u), _norm(next_state.u - state.u)
        # A shortened step is small too, but leaves most of its residual.
        short = (step <= _CONTRACTION * way) & (next_state.load >= 1.0)
        short &= next_state.relative_residual <= _GOOD_STEP * state.relative_residual
        finished = short | (next_state.status == Status.CONVERGED)
        return next_state, finished, step / jnp.where(way > 0, way, 1.0)

    def unfinished(carry: tuple[NewtonState, jax.Array, jax.Array]) -> jax.Array:
        state, finished, _ = carry
        running = (state.status == Status.RUNNING) & (state.load >= 1.0)
        return running & ~finished & (state.iterations < _MOST_ITERATIONS)

    start = stepping.begin(u)
    converged = start.status == Status.CONVERGED
    state, finished, ratio = while_loop(unfinished, advance, (start, converged, jnp.array(0.0)))
    follower = system.follower_force(u, theta)
    gap = system.potential(u, theta, 1.0, follower)[0]
    gap = gap - system.potential(state.u, theta, 1.0, follower)[0]
    return Distance(u - state.u, gap, ratio, state.iterations, jnp.array(False), finished)
