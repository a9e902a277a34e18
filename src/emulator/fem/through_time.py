r"""Finite elements of a body in time: its stress relaxes, or its mass resists.

A step at a point is a hyperelastic law (:mod:`emulator.viscosity`),

.. math:: W + (s - 1)\, W_\text{iso} + A : E + \tfrac{d}{2} E : E,

with factors s and d and a stress A that are known before the step; mass and dashpots are springs
whose other end is known (:mod:`emulator.viscosity.motion`). So a step of a body is a scene at rest,
with this law and these supports, whose tissue has s, d and A at every quadrature point. Everything
that solves elastic scenes solves it: Newton's method, mean dilatation, loads, supports. The scene
and its programs are the same in each step: what is known follows theta in one vector, so the
derivatives of an equilibrium in theta are those of any equilibrium, and the chain rule carries them
through time. With the knowledge k of a step, which follows from the past m,

.. math::
    \frac{du_i}{d\theta} = -K_i^{-1} \left[\frac{\partial r_i}{\partial \theta}
        + \frac{\partial r_i}{\partial k} \frac{dk(m_{i-1}, \theta)}{d\theta}\right], \qquad
    m_i = m(m_{i-1}, u_i, \theta) .

A scene has only the parts that it calls for: without viscosity no s, d and A, without inertia no
mass. The law, and so the memory, sees the mean change of volume of the block where dilatation is
shared. Errors are of second order in the length of a step, and none of one in which nothing moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from skfem.quadrature import get_quadrature
from skfem.refdom import RefTet

from emulator.core.errors import InputError
from emulator.core.kept import kept
from emulator.core.machine import require_float64
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled, is_traced, scan
from emulator.fem.derivatives import SolutionMap, differentiable
from emulator.fem.energy import at_points, law_gradients, parameters_at
from emulator.fem.newton import NewtonOptions
from emulator.fem.solution import Solution, Status
from emulator.geometry.discretisation import Discretisation, shapes_at
from emulator.geometry.mesh import Mesh
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law
from emulator.scenes.part import BoundaryCondition, LocalTerm, Values
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Dashpots
from emulator.scenes.tissue import Tissue
from emulator.viscosity.motion import (
    Anchor,
    Motion,
    mass_anchor,
    motion_after,
    rate_anchor,
    rest,
)
from emulator.viscosity.overstress import (
    Energy,
    Memory,
    TimeStep,
    isochoric_stress,
    memory_after,
    potential,
    step_after,
)
from emulator.viscosity.series import KELVIN_VOIGT
from emulator.viscosity.times import TIME, check_times

_ROWS = 4  # of a point's tissue: the stress A, and (s, d, 0)
_MASS, _DASHPOTS = "mass of the step", "dashpots of the step"  # names of anchors among the values


@dataclass(frozen=True)
class StepLaw(Law):
    """A law whose energy is that of a step, and the ``elastic`` law that it is made of."""

    elastic: Law | None = None

    @classmethod
    def of(cls, law: Law, *, kind: str = "prony") -> StepLaw:
        """Return the law of a step, with viscosity of a ``kind``."""

        def energy(strain: Strain, *parameters: jax.Array) -> jax.Array:
            H, rows = strain.H, strain.directions
            assert rows is not None
            fibres = {0: None, 1: rows[0]}.get(len(rows) - _ROWS, rows[:-_ROWS])
            elastic, A = _energy(law, parameters, fibres), rows[-_ROWS:-1]
            if kind != KELVIN_VOIGT:
                return potential(elastic, TimeStep(rows[-1, 0], A))(H)
            E = strain.green_lagrange
            return elastic(H) + jnp.vdot(A, E) + 0.5 * rows[-1, 1] * jnp.vdot(E, E)

        entries = {field.name: getattr(law, field.name) for field in fields(law)}
        entries |= {"energy": energy, "exponential": False, "simpler": ()}
        return cls(**entries, elastic=law)


def _energy(law: Law, parameters: Sequence[jax.Array], directions: Any) -> Energy:
    return lambda H: law.energy(Strain(H, None, directions), *parameters)


@dataclass(frozen=True)
class Anchored(BoundaryCondition):
    """Mass and dashpots of a step: springs, whose other end is an :class:`Anchor`.

    density : the mass density in kg/mm3, or None.
    dashpots : the supports that resist velocities.
    """

    density: float | None
    dashpots: tuple[Dashpots, ...]

    def terms(self, grid: Discretisation) -> tuple[LocalTerm, ...]:
        """Return the potentials of the springs."""
        masses = []
        if self.density is not None:
            data = self.density * masses_of(grid), grid.connectivity
            masses = [LocalTerm(grid.connectivity, data, _of_mass, convex=True)]
        rates = (support.quadratic(grid) for support in self.dashpots)
        dampers = [
            LocalTerm(t.nodes, (t.data, t.nodes), partial(_of_rate, t), convex=True) for t in rates
        ]
        return (*masses, *dampers)

    def resisted(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:  # noqa: ARG002
        """Return nothing: a step resists, the body at rest does not."""
        return np.zeros((0, 3)), np.zeros((0, 3))


def masses_of(grid: Discretisation) -> np.ndarray:
    """Return the integrals (m, a, a) in mm3 of the products of the shape functions."""
    order = grid.mesh.order
    points, weights = get_quadrature(RefTet, 2 * order)
    values, slopes = shapes_at(order, np.column_stack([1.0 - points.sum(axis=0), *points]))
    jacobian = np.einsum("mai,qaj->mqij", grid.mesh.nodes[grid.connectivity], slopes)
    return np.einsum("mq,q,qa,qb->mab", np.linalg.det(jacobian), weights, values, values)


def _of_mass(u: jax.Array, data: tuple[jax.Array, jax.Array], values: Values) -> jax.Array:
    masses, nodes = data
    factor, place = cast(Anchor, values[_MASS])
    way = u - place[nodes]
    return 0.5 * factor * jnp.vdot(way, masses @ way)


def _of_rate(term: LocalTerm, u: jax.Array, data: tuple[Any, jax.Array], values: Any) -> jax.Array:
    of_facet, nodes = data
    factor, place = values[_DASHPOTS]
    return term.energy(factor * (u - place[nodes]), of_facet, values) / factor


class Known(NamedTuple):
    """What is known before a step; None of what the scene does not have.

    points : the stress A of the points, and (s, d, 0), (b, q, 4, 3).
    mass, dashpots : the anchors of all nodes.
    """

    points: jax.Array | None
    mass: Anchor | None
    dashpots: Anchor | None


class StepScene(Scene):
    """A step of a body as a scene; what is known of it follows the parameters in theta."""

    is_step = True

    @classmethod
    def of(cls, scene: Scene) -> StepScene:
        """Return the step of a scene in time."""
        entries = {field.name: getattr(scene, field.name) for field in fields(scene)}
        if scene.viscosity is not None:
            entries["law"] = StepLaw.of(scene.law, kind=scene.viscosity.kind)
        density = None if scene.inertia is None else scene.inertia.mass_density
        dashpots = tuple(cast(Dashpots, s) for s in scene.supports if s.resists_velocity)
        return cls(**entries | {"supports": (*scene.supports, Anchored(density, dashpots))})

    @cached_property
    def known(self) -> Any:
        """A :class:`Known` of places (...) in theta, after the parameters."""
        anchored, count = cast(Anchored, self.supports[-1]), len(self.parameters)

        def places(*shape: int) -> np.ndarray:
            nonlocal count
            count += (size := int(np.prod(shape)))
            return np.arange(count - size, count).reshape(shape)

        points = mass = dashpots = None
        if self.viscosity is not None:
            points = places(*self.blocks.weights.shape, _ROWS, 3)
        if anchored.density is not None:
            mass = Anchor(*(cast(Any, places(*shape)) for shape in ((), self.held.shape)))
        if anchored.dashpots:
            dashpots = Anchor(*(cast(Any, places(*shape)) for shape in ((), self.held.shape)))
        return Known(cast(Any, points), mass, dashpots)

    def resolve(self, theta: jax.Array) -> dict[str, Any]:
        """Return every parameter and constant by name, and the anchors of the step."""
        known = jax.tree.map(lambda places: theta[places], self.known._replace(points=None))
        return super().resolve(theta) | {_MASS: known.mass, _DASHPOTS: known.dashpots}

    def block_tissue_at(self, theta: jax.Array) -> Tissue:
        """Return material data at ``theta``, with A, s and d as further rows of the directions."""
        tissue = super().block_tissue_at(theta)
        if self.known.points is None:
            return tissue
        rows = theta[self.known.points]
        if tissue.directions is not None:
            shape = self.blocks.weights.shape
            fibres = jnp.reshape(jnp.asarray(tissue.directions), (*shape, -1, 3))
            rows = jnp.concatenate([fibres, rows], axis=2)
        return tissue._replace(directions=rows)

    def elastic_tissue_at(self, theta: jax.Array) -> Tissue:
        """Return material data at ``theta`` (p,) without A, s and d."""
        return super().block_tissue_at(theta)


@kept
def system_of(scene: Scene) -> System:
    """Return the equations of a step of ``scene``, which keep what they compile."""
    return System(StepScene.of(scene))


@kept
def _solver_of(scene: Scene, options: NewtonOptions) -> SolutionMap:
    """Return what solves a step of ``scene``."""
    return differentiable(system_of(scene), options)


class Past(NamedTuple):
    """All that the next steps depend on; None of what the scene does not have.

    motion : the motion at the last time.
    memory : the memory of the points' stress (b, q, ...).
    strains : the Green-Lagrange strains of the last two times, (2, b, q, 3, 3).
    """

    motion: Motion
    memory: Memory | None
    strains: jax.Array | None


def at_rest(scene: Scene) -> Past:
    """Return the past of a body at rest at time 0."""
    shape, memory, strains = scene.blocks.weights.shape, None, None
    if scene.viscosity is not None and scene.viscosity.kind == KELVIN_VOIGT:
        strains = jnp.zeros((2, *shape, 3, 3))
    elif scene.viscosity is not None:
        overstress = jnp.zeros((*shape, scene.viscosity.count, 3, 3))
        memory = Memory(overstress, jnp.zeros((*shape, 3, 3)))
    return Past(rest(scene.held.shape), memory, strains)


@compiled
def before_step(system: System, past: Past, theta: jax.Array, interval: jax.Array) -> jax.Array:
    """Return theta and, after it, what is known of a step of ``interval`` s."""
    scene, motion = cast(StepScene, system.scene), past.motion
    points = mass = dashpots = None
    if scene.viscosity is not None:
        points = _known_of_points(scene, past, theta, interval)
    if scene.known.mass is not None:
        mass = mass_anchor(scene.inertia, motion, interval)
    if scene.known.dashpots is not None:
        dashpots = rate_anchor(motion.u, motion.before, motion, interval)
    known = jax.tree.leaves(Known(points, mass, dashpots))
    return jnp.concatenate([theta, *(jnp.reshape(part, -1) for part in known)])


def _known_of_points(
    scene: StepScene, past: Past, theta: jax.Array, interval: jax.Array
) -> jax.Array:
    """Return A, and (s, d, 0), of all points, (b q, 4, 3)."""
    values, memory = Scene.resolve(scene, theta), past.memory
    if memory is None:
        assert past.strains is not None
        before = past.strains.reshape(2, -1, 3, 3)
        rate = rate_anchor(before[0], before[1], past.motion, interval)
        damping = values["eta"] * rate.factor
        numbers = jnp.stack([jnp.ones(()), damping, jnp.zeros(())])
        last = jnp.broadcast_to(numbers, (before.shape[1], 1, 3))
        return jnp.concatenate([-damping * rate.place, last], axis=1)
    series = scene.viscosity.series(values)
    points = jax.tree.map(lambda field: field.reshape(-1, *field.shape[2:]), memory)
    scale, stress = jax.vmap(lambda point: step_after(point, series, interval))(points)
    last = jnp.zeros((len(scale), 1, 3)).at[:, 0, 0].set(scale)
    return jnp.concatenate([stress, last], axis=1)


@compiled
def after_step(
    system: System, past: Past, u: jax.Array, theta: jax.Array, interval: jax.Array
) -> Past:
    """Return the past after a step of ``interval`` s to ``u`` (n, 3) mm."""
    scene = cast(StepScene, system.scene)
    motion = motion_after(scene.inertia, past.motion, u, interval)
    if past.strains is not None:
        E = at_points(lambda H: Strain(H).green_lagrange, law_gradients(scene, u))
        return Past(motion, None, jnp.stack([E, past.strains[0]]))
    if past.memory is None:
        return Past(motion, None, None)
    law, parameters = cast(StepLaw, scene.law).elastic, parameters_at(scene, theta)
    series = scene.viscosity.series(scene.resolve(theta))
    assert law is not None

    def after(H: jax.Array, at: Tissue, before: Memory) -> Memory:
        stress = isochoric_stress(_energy(law, parameters(at), at.directions), H)
        return memory_after(before, series, interval, stress)

    tissue = scene.elastic_tissue_at(theta)
    memory = at_points(after, law_gradients(scene, u), tissue, past.memory)
    return Past(motion, cast(Memory, memory), None)


def through_time(scene: Scene, options: NewtonOptions, thetas: jax.Array) -> Solution:
    """Return the equilibria of a body in time, one after the other, from rest at time 0.

    Fields of the solution gain an axis m. The displacement is differentiable in ``thetas``. After a
    step that fails all later ones have its status.

    Parameters
    ----------
    scene : the body.
    options : the controls of Newton's method.
    thetas : theta at each time, (m, p): the same tissue, under other loads. The first is reached
        evenly from rest; two equal times are a jump, of a body without inertia and rates.

    Raises
    ------
    InputError
        A time that is below 0, falls, or stays where there is inertia or a rate; float64 is off.
    """
    require_float64("FEM")
    times = thetas[:, scene.parameter_names.index(TIME)]
    system, equilibrium = system_of(scene), _solver_of(scene, options)
    if not is_traced(times):
        _check(scene, np.asarray(times))

    def step(
        state: tuple[Past, jax.Array], row: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[Past, jax.Array], Solution]:
        (past, status), (theta, interval) = state, row
        u, _, velocity, *_ = past.motion
        # A body at rest starts from there: supports that jump alone would invert elements.
        ahead = scene.on_supports(u + interval * velocity, theta)
        start = jnp.where(jnp.any(u != 0.0), ahead, 0.0)
        whole = before_step(system, past, theta, interval)
        solution = equilibrium(whole, jax.lax.stop_gradient(start))
        failed = status != Status.CONVERGED
        solution = solution._replace(status=jnp.where(failed, status, solution.status))
        past = after_step(system, past, solution.displacement, whole, interval)
        return (past, solution.status), solution

    intervals = jnp.diff(times, prepend=0.0)
    first = at_rest(scene), jnp.asarray(int(Status.CONVERGED))
    solutions: Solution = scan(step, first, (thetas, intervals))[1]
    return solutions


def _check(scene: Scene, times: np.ndarray) -> None:
    """Refuse times (m,) that are no way through time."""
    check_times(times, {"": np.arange(len(times))}, len(times))
    rates = scene.inertia is not None or any(s.resists_velocity for s in scene.supports)
    rates |= scene.viscosity is not None and scene.viscosity.kind == KELVIN_VOIGT
    if rates and (still := np.flatnonzero(np.diff(times, prepend=0.0) == 0.0)).size:
        raise InputError(
            f"scene '{scene.name}': row {still[0] + 1}: time stays {times[still[0]]:g} s; with "
            "inertia or a rate it must rise, from above 0"
        )
