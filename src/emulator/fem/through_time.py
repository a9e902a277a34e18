r"""Finite elements of a body whose stress relaxes, from one time to the next.

A step at a point is a hyperelastic law (:mod:`emulator.viscosity`),

.. math:: W + (s - 1)\, W_\text{iso} + A : E,

with a factor s and a stress A that are known before the step. So a step of a body is a scene at
rest, whose law has this energy and whose tissue has s and A at every quadrature point. Everything
that solves elastic scenes solves it: Newton's method, mean dilatation, loads, supports. The scene
and its programs are the same in each step: s and A follow theta in one vector, so the derivatives
of an equilibrium in theta are those of any equilibrium, and the chain rule carries them through
time, with the memory,

.. math::
    \frac{du_k}{d\theta} = -K_k^{-1} \left[\frac{\partial r_k}{\partial \theta}
        + \frac{\partial r_k}{\partial (s, A)}
          \frac{d(s, A)(m_{k-1}, \theta)}{d\theta}\right], \qquad
    m_k = m(m_{k-1}, u_k, \theta) .

The law, and so the memory, sees the mean change of volume of the block where dilatation is shared.

Errors are those of the step, which takes the isochoric stress to go straight in time: of second
order in its length, and none of one in which nothing moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.kept import kept
from emulator.core.machine import require_float64
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled, is_traced, scan
from emulator.fem.derivatives import SolutionMap, differentiable
from emulator.fem.energy import at_points, law_gradients, parameters_at
from emulator.fem.newton import NewtonOptions
from emulator.fem.solution import Solution, Status
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue
from emulator.viscosity.overstress import (
    Energy,
    Memory,
    TimeStep,
    isochoric_stress,
    memory_after,
    potential,
    step_after,
)
from emulator.viscosity.times import TIME, check_times

_ROWS = 4  # of a point's tissue: the stress A, and s


@dataclass(frozen=True)
class StepLaw(Law):
    """A law whose energy is that of a step, and the ``elastic`` law that relaxes."""

    elastic: Law | None = None

    @classmethod
    def of(cls, law: Law) -> StepLaw:
        """Return the law of a step."""

        def energy(strain: Strain, *parameters: jax.Array) -> jax.Array:
            H, rows = strain.H, strain.directions
            assert rows is not None
            fibres = {0: None, 1: rows[0]}.get(len(rows) - _ROWS, rows[:-_ROWS])
            step = TimeStep(rows[-1, 0], rows[-_ROWS:-1])
            return potential(_energy(law, parameters, fibres), step)(H)

        entries = {field.name: getattr(law, field.name) for field in fields(law)}
        entries |= {"energy": energy, "exponential": False, "simpler": ()}
        return cls(**entries, elastic=law)


def _energy(law: Law, parameters: Sequence[jax.Array], directions: Any) -> Energy:
    return lambda H: law.energy(Strain(H, None, directions), *parameters)


class StepScene(Scene):
    """A step of a body as a scene; s and A of its points follow the parameters in theta."""

    relaxes = False

    def block_tissue_at(self, theta: jax.Array) -> Tissue:
        """Return material data at ``theta``, with s and A as further rows of the directions."""
        tissue, shape = super().block_tissue_at(theta), self.blocks.weights.shape
        rows = theta[len(self.parameters) :].reshape(*shape, _ROWS, 3)
        if tissue.directions is not None:
            fibres = jnp.reshape(jnp.asarray(tissue.directions), (*shape, -1, 3))
            rows = jnp.concatenate([fibres, rows], axis=2)
        return tissue._replace(directions=rows)

    def elastic_tissue_at(self, theta: jax.Array) -> Tissue:
        """Return material data at ``theta`` (p,) without s and A."""
        return super().block_tissue_at(theta)


@kept
def _steps_of(scene: Scene, options: NewtonOptions) -> tuple[System, SolutionMap]:
    """Return the equations of a step of ``scene``, and what solves them, compiled once."""
    entries = {field.name: getattr(scene, field.name) for field in fields(scene)}
    system = System(StepScene(**(entries | {"law": StepLaw.of(scene.law)})))
    return system, differentiable(system, options)


@compiled
def _before_step(
    system: System, memory: Memory, theta: jax.Array, interval: jax.Array
) -> jax.Array:
    """Return theta with s and A of all points after it, of a step of ``interval`` s."""
    scene = system.scene
    series = scene.viscosity.series(scene.resolve(theta))
    points = jax.tree.map(lambda field: field.reshape(-1, *field.shape[2:]), memory)
    scale, stress = jax.vmap(lambda point: step_after(point, series, interval))(points)
    last = jnp.zeros((len(scale), 1, 3)).at[:, 0, 0].set(scale)
    return jnp.concatenate([theta, jnp.concatenate([stress, last], axis=1).reshape(-1)])


@compiled
def _after_step(
    system: System, memory: Memory, u: jax.Array, theta: jax.Array, interval: jax.Array
) -> Memory:
    """Return the memory after a step of ``interval`` s to ``u`` (n, 3) mm."""
    scene = cast(StepScene, system.scene)
    law = cast(StepLaw, scene.law).elastic
    series, parameters = scene.viscosity.series(scene.resolve(theta)), parameters_at(scene, theta)
    assert law is not None

    def after(H: jax.Array, at: Tissue, before: Memory) -> Memory:
        stress = isochoric_stress(_energy(law, parameters(at), at.directions), H)
        return memory_after(before, series, interval, stress)

    tissue = scene.elastic_tissue_at(theta)
    return cast(Memory, at_points(after, law_gradients(scene, u), tissue, memory))


def through_time(scene: Scene, options: NewtonOptions, thetas: jax.Array) -> Solution:
    """Return the equilibria of a body with viscosity, one after the other, from rest at time 0.

    Fields of the solution gain an axis m. The displacement is differentiable in ``thetas``. After a
    step that fails all later ones have its status.

    Parameters
    ----------
    scene : the body.
    options : the controls of Newton's method.
    thetas : theta at each time, (m, p): the same tissue, under other loads. The first is reached
        evenly from rest; two equal times are a jump.

    Raises
    ------
    InputError
        A time that is below 0 or falls; float64 is off.
    """
    require_float64("FEM")
    times = thetas[:, scene.parameter_names.index(TIME)]
    if not is_traced(times):
        check_times(np.asarray(times), {"": np.arange(len(times))}, len(times))
    system, equilibrium = _steps_of(scene, options)
    shape, count = scene.blocks.weights.shape, scene.viscosity.count
    memory = Memory(jnp.zeros((*shape, count, 3, 3)), jnp.zeros((*shape, 3, 3)))

    def step(
        state: tuple[jax.Array, Memory, jax.Array], row: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, Memory, jax.Array], Solution]:
        (u, memory, status), (theta, interval) = state, row
        # A body at rest starts from there: supports that jump alone would invert elements.
        start = jnp.where(jnp.any(u != 0.0), scene.on_supports(u, theta), 0.0)
        whole = _before_step(system, memory, theta, interval)
        solution = equilibrium(whole, jax.lax.stop_gradient(start))
        failed = status != Status.CONVERGED
        solution = solution._replace(status=jnp.where(failed, status, solution.status))
        u = solution.displacement
        return (u, _after_step(system, memory, u, theta, interval), solution.status), solution

    intervals = jnp.diff(times, prepend=0.0)
    first = jnp.zeros(scene.held.shape), memory, jnp.asarray(int(Status.CONVERGED))
    solutions: Solution = scan(step, first, (thetas, intervals))[1]
    return solutions
