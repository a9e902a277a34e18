r"""Estimates of equilibria: one guarded step from the displacements that a map predicts.

At each theta a few conjugate gradients for the linearised equations,

.. math:: K(v_i, \theta_i)\, e_i = -r(v_i, \theta_i),

preconditioned by one Cholesky factor for eight neighbours, that of the tangent at the prediction in
their middle. Newton's guard decides which fraction of :math:`e_i` is taken: the step lowers the
potential and inverts no element. There is no iteration at a theta, and no solution of FEM.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem import Simulator
from emulator.fem.assembly import System
from emulator.fem.campaign import at_once, in_order
from emulator.fem.compiled import compiled
from emulator.fem.linear import Outcome
from emulator.fem.linear.reuse import conjugate_gradients
from emulator.fem.newton import ARMIJO, armijo, backtrack

Map = Callable[[jax.Array], jax.Array]
"""A map from the position (p,) in the unit box to the displacement (n, 3) mm."""

_GROUP = 8  # theta that share a factor
_MIDDLES = 3  # members of a group whose tangents may be factorised, the middle first
_STEPS, _TOLERANCE = 4, 1e-8  # steps and tolerance of conjugate gradients
_LEAST_J = 0.05
_LEAST_FRACTION = 2.0**-7
_UNSEEN = 16  # theta at which a trained map is measured
_CONTRACTION = 0.25  # largest ratio of residuals after and before a step that tells an error


class Targets(NamedTuple):
    """The targets at c theta.

    fields : the free displacements after the step, (c, f) mm.
    step : the root mean square over the nodes of the whole step, (c,) mm.
    fraction : the fraction of the step that is taken, 0 for none, (c,).
    contraction : the ratio of the residuals after and before the step, in the norm of the factor's
        inverse, (c,).
    gap : the relative decrease of the potential by the step, (c,).
    """

    fields: Any
    step: Any
    fraction: Any
    contraction: Any
    gap: Any

    @property
    def error(self) -> np.ndarray:
        """The remaining error of each target, (c,) mm; infinite where no step was taken."""
        with np.errstate(invalid="ignore"):
            error = self.step * (1.0 - self.fraction + self.fraction * self.contraction)
        usable = (self.fraction > 0.0) & np.isfinite(error) & np.isfinite(self.fields).all(axis=1)
        return np.where(usable, error, np.inf)


def targets(
    simulator: Simulator,
    fields: np.ndarray,
    position: np.ndarray,
    level: float,
    *,
    group: int = _GROUP,
    first: bool = True,
) -> Targets:
    """Return the targets at ``position`` (c, p) in the unit box.

    fields : the free displacements that the map predicts, (c, f) mm.
    level : the level of the loads and of moved supports.
    group : the number of theta that share a factor; c is a power of two times as many.
    first : whether the process has not compiled this before.
    """
    system, load = simulator.system, jnp.asarray(level)
    thetas = np.asarray(simulator.scene.from_unit(jnp.asarray(position)))
    groups = _groups(position, group)

    def of_group(rows: np.ndarray) -> Targets:
        for middle in rows[:_MIDDLES]:
            tangent, definite = _tangent(system, fields[middle], thetas[middle], load)
            if bool(definite):
                group_targets = [_target(system, tangent, fields[k], thetas[k], load) for k in rows]
                return jax.tree.map(lambda *numbers: np.stack(numbers), *group_targets)
        nothing = np.zeros(len(rows))
        return Targets(fields[rows], nothing + np.inf, nothing, nothing, nothing + np.inf)

    results = in_order(of_group, iter(groups), at_once(simulator), alone=int(first))
    back = np.argsort(np.concatenate(groups))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[back], *results)


def free_fields(simulator: Simulator, displacement: Map, position: np.ndarray) -> np.ndarray:
    """Return the free displacements (c, f) mm of a map at ``position`` (c, p)."""
    free = lambda x: simulator.system.restrict(displacement(x))  # noqa: E731
    return np.asarray(jax.lax.map(free, jnp.asarray(position)))


def distance_from_equilibrium(simulator: Simulator, displacement: Map, seed: int) -> dict[str, Any]:
    r"""Return a record of a map's error at theta drawn anew, by Newton's step at each of them.

    The step beside the tangent at the prediction is the error to first order, and the potential is
    :math:`\tfrac12 r \cdot K^{-1} r` above its least value. Where a step is shortened, or leaves
    more than a quarter of the residual, the error is not known.
    """
    from scipy.stats import qmc  # slow to import

    rng = np.random.default_rng([seed, _UNSEEN])  # sweeps draw theirs from the seed and a number
    position = qmc.Sobol(len(simulator.scene.parameters), rng=rng).random(_UNSEEN)
    fields = free_fields(simulator, displacement, position)
    steps = targets(simulator, fields, position, 1.0, group=1)
    known = (steps.fraction == 1.0) & (steps.contraction <= _CONTRACTION)
    record: dict[str, Any] = {"theta": _UNSEEN, "known": int(known.sum())}
    if known.any():
        errors, gaps = steps.step[known], 100.0 * steps.gap[known]
        record["error_mm"] = {"median": float(np.median(errors)), "max": float(errors.max())}
        record["energy_percent"] = {"median": float(np.median(gaps)), "max": float(gaps.max())}
    return record


def _displacement(system: System, v: jax.Array, theta: jax.Array, level: jax.Array) -> jax.Array:
    """Return the displacement (n, 3): ``v`` (f,) where free, prescribed elsewhere."""
    return system.scene.on_supports(system.extend(v), theta, level=level)


def _groups(position: np.ndarray, size: int) -> list[np.ndarray]:
    """Return the rows of ``position`` (c, p) in groups of ``size``, each from its middle on."""
    parts = [np.arange(len(position))]
    while len(parts[0]) > size:
        halves = []
        for rows in parts:
            widest = np.argmax(np.ptp(position[rows], axis=0))
            order = rows[np.argsort(position[rows, widest], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        parts = halves

    def from_middle(rows: np.ndarray) -> np.ndarray:
        away = np.sum((position[rows] - position[rows].mean(axis=0)) ** 2, axis=1)
        return rows[np.argsort(away, kind="stable")]

    return [from_middle(rows) for rows in parts]


@compiled
def _tangent(
    system: System, v: jax.Array, theta: jax.Array, level: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the nonzeros (nnz,) of the tangent at ``v`` (f,), and whether it is definite."""
    values, solvable = system.safe_tangent(_displacement(system, v, theta, level), theta, level)
    outcome = system.attempt(values, jnp.zeros_like(v))[1]
    return values, solvable & (outcome == Outcome.OK)


@compiled
def _target(
    system: System, factor: jax.Array, v: jax.Array, theta: jax.Array, level: jax.Array
) -> Targets:
    """Return the target from ``v`` (f,) at ``theta`` (p,), preconditioned by ``factor``."""

    def residual(v: jax.Array) -> jax.Array:
        return system.residual(_displacement(system, v, theta, level), theta, level)

    def precondition(force: jax.Array) -> jax.Array:
        return system.attempt(factor, force)[0]

    r, tangent_times = jax.linearize(residual, v)
    step = conjugate_gradients(tangent_times, precondition, -r, _STEPS, _TOLERANCE).x
    slope = jnp.vdot(r, step)

    def at(fraction: jax.Array) -> jax.Array:
        return _displacement(system, v + fraction * step, theta, level)

    def potential(fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
        return system.potential(at(fraction), theta, level)

    def valid(fraction: jax.Array) -> jax.Array:
        return system.least_volume_ratio(at(fraction)) > _LEAST_J  # False for NaN

    trial = backtrack(valid, armijo(potential, ARMIJO * slope), _LEAST_FRACTION)
    usable = trial.accepted & (slope <= 0.0)  # False for NaN
    fraction = jnp.where(usable, trial.fraction, 0.0)
    target = jnp.where(usable, v + fraction * step, v)
    rest = residual(target)
    initial_norm, final_norm = jnp.vdot(r, precondition(r)), jnp.vdot(rest, precondition(rest))
    contraction = jnp.sqrt(jnp.abs(final_norm) / jnp.where(initial_norm > 0.0, initial_norm, 1.0))
    length = jnp.sqrt(jnp.sum(step**2) / system.scene.held.shape[0])
    size = potential(jnp.zeros(()))[1]
    return Targets(target, length, fraction, contraction, -0.5 * slope / size)
