r"""One time step at a material point, and all steps of a test (:mod:`emulator.viscosity`).

A step is a hyperelastic law, so that what finds equilibrium without viscosity finds it here; what
is remembered from step to step is the isochoric stress and the overstress of each term. Everything
is written for one point; ``jax.lax.scan`` follows time, so derivatives through it are exact.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.mechanics.kinematics import Strain, cofactor
from emulator.viscosity.series import Series

_FOREVER = 1e30  # s
Energy = Callable[..., jax.Array]
"""The energy density in kPa of a displacement gradient (3, 3) and what else it reads."""


class Memory(NamedTuple):
    """The memory of a point: it determines the next steps together with the motion.

    overstress : the overstress of each term, kPa, (a, 3, 3).
    stress : the isochoric second Piola-Kirchhoff stress of the law, kPa, (3, 3).
    """

    overstress: jax.Array
    stress: jax.Array


class TimeStep(NamedTuple):
    """The potential of a time step, :math:`W_vol + s W_iso + A : E`.

    scale : the factor s of the isochoric energy, ().
    stress : the second Piola-Kirchhoff stress A that is known before the step, kPa, (3, 3).
    """

    scale: jax.Array
    stress: jax.Array


def at_rest(series: Series) -> Memory:
    """Return the memory of a point that was never loaded."""
    return Memory(jnp.zeros((len(series.times), 3, 3)), jnp.zeros((3, 3)))


def _decay(series: Series, interval: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return what is left of overstress after an interval, and of stress added evenly, (a,)."""
    # An infinite interval has infinite derivatives in the times, which times 0 are NaN.
    x = jnp.minimum(interval, _FOREVER) / series.times
    small = x < 1e-9
    safe = jnp.where(small, 1.0, x)  # else the unused branch has the derivative of 0/0
    return jnp.exp(-x), jnp.where(small, 1.0 - 0.5 * x, -jnp.expm1(-safe) / safe)


def step_after(memory: Memory, series: Series, interval: jax.Array) -> TimeStep:
    """Return the potential of a step of ``interval`` s; 0 is an instant one."""
    left, even = _decay(series, interval)
    added = even * series.fractions
    scale = 1.0 - jnp.sum(series.fractions) + jnp.sum(added)
    return TimeStep(
        scale, jnp.tensordot(left, memory.overstress, 1) - jnp.sum(added) * memory.stress
    )


def memory_after(memory: Memory, series: Series, interval: jax.Array, stress: jax.Array) -> Memory:
    """Return the memory after a step of ``interval`` s to the isochoric ``stress`` in kPa."""
    left, even = _decay(series, interval)
    added = (even * series.fractions)[:, None, None] * (stress - memory.stress)
    return Memory(left[:, None, None] * memory.overstress + added, stress)


def isochoric(H: jax.Array) -> jax.Array:
    """Return the displacement gradient (3, 3) of :math:`J^{-1/3} F`, which has no volume change."""
    return H + jnp.expm1(-Strain(H).ln_J / 3.0) * (H + jnp.eye(3))


def isochoric_stress(energy: Energy, H: jax.Array, *tissue: Any) -> jax.Array:
    r"""Return the second Piola-Kirchhoff stress (3, 3) in kPa of the isochoric energy.

    With :math:`\bar F = J^{-1/3} F` and :math:`\bar P = \partial W(\bar F) / \partial \bar F`

    .. math::
        S_\text{iso} = J^{-2/3} \bar F^{-1}
            \left(\bar P - \tfrac13 (\bar P : \bar F)\, \bar F^{-T}\right) .
    """
    even = isochoric(H)
    F = even + jnp.eye(3)
    P, G = jax.grad(energy)(even, *tissue), cofactor(F)
    return jnp.exp(-2.0 / 3.0 * Strain(H).ln_J) * G.T @ (P - jnp.vdot(P, F) / 3.0 * G)


def potential(energy: Energy, step: TimeStep, *, incompressible: bool = False) -> Energy:
    """Return the potential of a step in kPa, as a function of what ``energy`` reads.

    incompressible : whether J is 1 wherever it is evaluated, so that the whole law is isochoric.
    """

    def value(H: jax.Array, *tissue: Any) -> jax.Array:
        known = jnp.vdot(step.stress, Strain(H).green_lagrange)
        if incompressible:
            return step.scale * energy(H, *tissue) + known
        shape = energy(isochoric(H), *tissue)
        return energy(H, *tissue) + (step.scale - 1.0) * shape + known

    return value


def linearised(moduli: Callable[..., Any], step: TimeStep, H: jax.Array, *tissue: Any) -> Any:
    """Return stress (3, 3) and moduli (3, 3, 3, 3) in kPa of the potential where J is 1.

    moduli : the function that returns those of the law.
    """
    P, C = moduli(H, *tissue)
    geometric = jnp.einsum("ik,lj->ijkl", jnp.eye(3), step.stress)
    stress = step.scale * P + (H + jnp.eye(3)) @ step.stress
    return stress, step.scale * C + geometric


class Histories(NamedTuple):
    """The points of tests through time, padded to the longest test by repeats of its last row.

    rows : the state of each point at each time, (p, t).
    intervals : the time since the state before, s, (p, t); since rest at time 0 for the first.
    positions : the point and the time of each state, (2, m).
    """

    rows: np.ndarray
    intervals: np.ndarray
    positions: np.ndarray

    def along(self, series: Series, advance: Callable[..., Any], inputs: Any) -> Any:
        """Return the outcomes of ``advance`` at all states, (m, ...), by a scan over time.

        advance : the function of memory, interval and a state's inputs that returns the memory
            after the state, and its outcome.
        inputs : a tree of arrays (m, ...).
        """

        def of_point(intervals: jax.Array, inputs: Any) -> Any:
            step = lambda memory, row: advance(memory, row[0], *row[1])  # noqa: E731
            return jax.lax.scan(step, at_rest(series), (intervals, inputs))[1]

        by_time = jax.tree.map(lambda values: values[self.rows], inputs)
        outcomes = jax.vmap(of_point)(jnp.asarray(self.intervals), by_time)
        return jax.tree.map(lambda values: values[tuple(self.positions)], outcomes)

    def steps(self, series: Series, stresses: jax.Array) -> TimeStep:
        """Return the steps that lead to all states, (m, ...), from their isochoric stresses."""

        def advance(
            memory: Memory, interval: jax.Array, stress: jax.Array
        ) -> tuple[Memory, TimeStep]:
            step = step_after(memory, series, interval)
            return memory_after(memory, series, interval, stress), step

        return self.along(series, advance, (stresses,))


def histories(tests: Mapping[str, np.ndarray], times: np.ndarray, size: int = 1) -> Histories:
    """Return the histories of the points of tests.

    tests : the states (k size,) of each test by name, those of one time together.
    times : the time of each measured state, s, (m / size,).
    size : the number of points of a measured state.
    """
    paths = [path for rows in tests.values() for path in rows.reshape(-1, size).T]
    longest = max(map(len, paths))
    rows = np.stack([np.pad(path, (0, longest - len(path)), mode="edge") for path in paths])
    positions = np.empty((2, len(times) * size), int)
    for point, path in enumerate(paths):
        positions[0, path], positions[1, path] = point, np.arange(len(path))
    return Histories(rows, np.diff(times[rows // size], axis=1, prepend=0.0), positions)
