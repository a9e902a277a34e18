r"""Specimens without a mesh: the equilibrium of every homogeneous state by itself.

Free stretches d minimise the energy density, compressible or not,

.. math::
    \min_d W(H(d)) - \sum_i P_i H_{ii}(d) \qquad\text{or}\qquad
    \text{the same with }\; \det F(d) = 1 ,

where a test under load control pulls with :math:`P_i`, by Newton's method from the stretches that
keep the volume (:mod:`emulator.core.small_newton`); every stretch stays positive. An incompressible
specimen needs no pressure: the last free stretch follows from the others,

.. math:: F_{ll} = (1 - \det F|_{F_{ll} = 0}) / \operatorname{cof}(F)_{ll} ,

and its pull, if it has one, does work like the others. First derivatives are those of the
equilibrium, by the implicit function theorem. All states are one batch, and so are all theta under
``vmap``. The compressible map is what certificates compare an incompressible one with: it tells
what the law's bulk modulus changes. It is exact, as finite elements are of such a state
(:mod:`emulator.verify.homogeneous`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.core.small_matrices import solve_modified
from emulator.core.small_newton import minimise_by_newton
from emulator.fem.energy import point_energy
from emulator.fem.material_point import stress_and_moduli
from emulator.fem.solution import Solution, Status
from emulator.mechanics.kinematics import cofactor
from emulator.scenes.scene import all_nodes, check_nodes
from emulator.specimens.specimen import Specimen, require_specimen
from emulator.surrogates.protocol import ForwardKind, Prediction, fingerprint_of
from emulator.viscosity.overstress import (
    Memory,
    TimeStep,
    isochoric_stress,
    linearised,
    memory_after,
    potential,
    step_after,
)

_GUESSES = np.concatenate([[0.0], np.geomspace(0.01, 0.9, 20)])  # strains along a pull


@dataclass(frozen=True, eq=False)
class Homogeneous:
    """The states of a specimen as a forward map.

    scene, nodes : the specimen, and the nodes (k,) whose displacement is returned.
    incompressible : whether no state changes its volume, whatever the law's bulk modulus.

    Raises
    ------
    InputError
        A scene that is no specimen; an incompressible state without a free direction.
    """

    scene: Specimen
    nodes: np.ndarray
    incompressible: bool = False

    engine = None

    def __post_init__(self) -> None:
        require_specimen(self.scene)
        closed = np.flatnonzero(~self.scene.states.free.any(axis=1))
        if self.incompressible and len(closed):
            raise InputError(
                f"state {closed[0] + 1} of '{self.scene.name}' has no free direction: an "
                "incompressible specimen needs one in each state"
            )

    @property
    def kind(self) -> str:
        """The name of the kind of map."""
        return "incompressible" if self.incompressible else "homogeneous"

    @property
    def label(self) -> str:
        """The name of the map in pictures and tables."""
        return f"{self.kind} specimen"

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the kind, the scene and the nodes."""
        return fingerprint_of(self.kind, self.scene.fingerprint, self.nodes)

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (k, 3) mm at ``theta`` (p,).

        :class:`SolverError` where a state has no equilibrium; inside ``jit`` nothing can be raised.
        """
        u, valid = self.evaluate(theta)
        if not isinstance(valid, jax.core.Tracer) and not valid:
            raise SolverError(f"scene '{self.scene.name}': a state has no equilibrium")
        return u

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the displacement (k, 3) mm, and whether all states are in equilibrium."""
        return self._program(theta)

    @cached_property
    def _program(self) -> Callable[[jax.Array], Prediction]:
        """The map, compiled once also where it is called by hand: its loops would be each time."""
        return jax.jit(self._evaluate)

    def _evaluate(self, theta: jax.Array) -> Prediction:
        rows, of_node = np.unique(self.nodes // 3, return_inverse=True)
        H, pulls = self.scene.states.gradients, self.scene.states.pulls
        if self.scene.viscosity is not None:  # a state depends on those before it
            rows, of_node = np.arange(len(H)), self.nodes // 3
        point = Point(point_energy(self.scene, theta), stress_and_moduli(self.scene, theta))
        tissue = jax.tree.map(lambda values: values[rows], self.scene.tissue_at(theta))
        guesses = _GUESSES if pulls.any() else _GUESSES[:0]
        axes, last = self._free(rows)
        states = jnp.asarray(H[rows]), jnp.asarray(pulls[rows]), axes, last, tissue
        if self.scene.viscosity is None or not axes.shape[1]:  # else the motion says everything
            settled, converged = jax.vmap(partial(equilibrium, point, guesses))(*states)
        else:
            settled, converged = self._through_time(point, guesses, theta, states)
        columns = jnp.swapaxes(settled, 1, 2)[of_node, self.nodes % 3]
        return Prediction(columns, jnp.all(converged))

    def _through_time(
        self, point: Point, guesses: np.ndarray, theta: jax.Array, states: Any
    ) -> tuple[jax.Array, jax.Array]:
        """Return what :func:`equilibrium` does of all ``states``, with viscosity."""
        assert self.scene.viscosity is not None
        series = self.scene.viscosity.series(self.scene.resolve(theta))

        def advance(memory: Memory, interval: jax.Array, *state: Any) -> tuple[Memory, Any]:
            step, tissue = step_after(memory, series, interval), state[-1]
            of_step = _of_step(point, step, incompressible=self.incompressible)
            H, converged = equilibrium(of_step, guesses, *state)
            stress = isochoric_stress(point.energy, H, tissue)
            return memory_after(memory, series, interval, stress), (H, converged)

        return self.scene.histories.along(series, advance, states)

    def _free(self, rows: np.ndarray) -> tuple[jax.Array, jax.Array | None]:
        """Return the axes (e, u) of the free stretches, 3 for none, and that of the last, (e,).

        The last one follows from the others where the specimen is incompressible, else it is None.
        It is one without a pull, if any free direction has none.
        """
        free, pulls = self.scene.states.free[rows], self.scene.states.pulls[rows]
        order = np.argsort(2 * ~free + 1 * (pulls == 0.0), axis=1, kind="stable")
        axes = np.where(np.take_along_axis(free, order, axis=1), order, 3)
        count = (axes < 3).sum(axis=1)
        if not self.incompressible:
            return jnp.asarray(axes[:, : count.max(initial=0)]), None
        last = jnp.asarray(axes[np.arange(len(rows)), count - 1])
        axes[np.arange(len(rows)), count - 1] = 3
        return jnp.asarray(axes[:, : (count - 1).max(initial=0)]), last

    def at(self, nodes: np.ndarray) -> Homogeneous:
        """Return the map restricted to ``nodes``: only their states are computed."""
        return replace(self, nodes=check_nodes(self.scene, nodes))

    # What a simulator does, so that certificates run the states where they run FEM of a scene.

    def solve(self, theta: jax.Array, start: jax.Array | None = None) -> Solution:  # noqa: ARG002
        """Return the equilibrium of all states at ``theta`` (p,); a ``start`` is not needed."""
        u, valid = self.evaluate(jnp.asarray(theta, dtype=float))
        status = jnp.where(valid, Status.CONVERGED, Status.ITERATION_LIMIT)
        count = jnp.zeros((), dtype=int)  # Newton's steps of a state are not counted
        return Solution(u, status, count, count, jnp.zeros(()), jnp.where(valid, 1.0, 0.0))

    def sensitivities(self, u: jax.Array, theta: jax.Array) -> jax.Array:  # noqa: ARG002
        """Return the derivatives (p, n, 3) of the equilibrium in ``theta`` (p,)."""
        return self._slopes(theta)

    @cached_property
    def _slopes(self) -> Callable[[jax.Array], jax.Array]:
        slopes = jax.jacfwd(lambda theta: self._evaluate(theta).displacement)
        return jax.jit(lambda theta: jnp.moveaxis(slopes(theta), -1, 0))

    def is_stable(self, u: jax.Array, theta: jax.Array) -> bool:
        """Return whether each state at ``u`` (n, 3) mm is a minimum in its free stretches."""
        moduli = self._moduli(self.scene.gradients(u), theta)
        free = self.scene.states.free
        stiffness = np.einsum("miijj->mij", np.asarray(moduli))
        both = free[:, :, None] & free[:, None, :]
        return bool((np.linalg.eigvalsh(np.where(both, stiffness, np.eye(3))) > 0.0).all())

    @cached_property
    def _moduli(self) -> Callable[[jax.Array, jax.Array], jax.Array]:
        def moduli(H: jax.Array, theta: jax.Array) -> jax.Array:
            if self.scene.viscosity is not None:
                energy, states = _densities(self.scene, H, theta)
                return jax.vmap(jax.hessian(energy))(*states)
            of_point = stress_and_moduli(self.scene, theta)
            return jax.vmap(of_point)(H, self.scene.tissue_at(theta))[1]

        return jax.jit(moduli)


def homogeneous_stresses(
    scene: Specimen, u: jax.Array, theta: jax.Array
) -> tuple[jax.Array, jax.Array]:
    r"""Return gradients H and first Piola-Kirchhoff stresses P in kPa of the states, (m, 3, 3).

    P is the law's stress less a pressure, at which the last free direction l has its pull
    :math:`P_l`, zero where nothing pulls,

    .. math::
        P = \frac{\partial W}{\partial F} - p \operatorname{cof} F, \qquad
        p = \Big(\frac{\partial W}{\partial F_{ll}} - P_l\Big) \Big/ \operatorname{cof}(F)_{ll} .

    It vanishes where a compressible specimen is in equilibrium, and is the unknown of an
    incompressible one. With viscosity, W is the potential of the step that leads to the state.

    u : the displacement (3 m, 3) mm of all nodes of the specimen ``scene``.
    """
    free, H = scene.states.free, scene.gradients(u)
    energy, states = _densities(scene, H, theta)
    of_law = jax.vmap(jax.grad(energy))(*states)
    last = np.where(free.any(axis=1), 2 - np.argmax(free[:, ::-1], axis=1), 3)
    cofactors = jax.vmap(cofactor)(H + jnp.eye(3))
    is_last = jnp.asarray(last[:, None] == np.arange(3))
    along = jnp.where(is_last, jnp.diagonal(cofactors, axis1=1, axis2=2), 1.0)
    excess = jnp.diagonal(of_law, axis1=1, axis2=2) - scene.states.pulls
    pressure = jnp.sum(jnp.where(is_last, excess / along, 0.0), axis=1)
    return H, of_law - pressure[:, None, None] * cofactors


def _densities(
    scene: Specimen, H: jax.Array, theta: jax.Array
) -> tuple[Callable[..., jax.Array], tuple[Any, ...]]:
    """Return the energy density in kPa whose slope is a state's stress, and its arguments.

    H : the gradients of all states, (m, 3, 3).
    """
    energy, tissue = point_energy(scene, theta), scene.tissue_at(theta)
    if scene.viscosity is None:
        return energy, (H, tissue)
    series = scene.viscosity.series(scene.resolve(theta))
    stresses = jax.vmap(partial(isochoric_stress, energy))(H, tissue)
    steps = scene.histories.steps(series, stresses)
    return lambda H, tissue, step: potential(energy, step)(H, tissue), (H, tissue, steps)


class Point(NamedTuple):
    """The law at one point, as functions of displacement gradient (3, 3) and tissue.

    energy : the energy density in kPa.
    moduli : stress dW/dH (3, 3) and moduli d2W/dH2 (3, 3, 3, 3), both in kPa.
    """

    energy: Callable[..., jax.Array]
    moduli: Callable[..., tuple[jax.Array, jax.Array]]


def _of_step(point: Point, step: TimeStep, *, incompressible: bool) -> Point:
    """Return the potential of a step with viscosity in the place of the law's energy."""
    energy = potential(point.energy, step, incompressible=incompressible)
    if incompressible:
        return Point(energy, partial(linearised, point.moduli, step))
    return Point(energy, lambda *at: (jax.grad(energy)(*at), jax.hessian(energy)(*at)))


def equilibrium(
    point: Point,
    guesses: np.ndarray,
    H: jax.Array,
    pulls: jax.Array,
    axes: jax.Array,
    last: jax.Array | None,
    tissue: Any,
) -> tuple[jax.Array, jax.Array]:
    """Return the displacement gradient (3, 3) of one state, and whether it is an equilibrium.

    Parameters
    ----------
    guesses : strains (g,) along the pulls, of which the one of least potential is the start; none
        where nothing pulls.
    H : the prescribed gradient (3, 3), zero in free directions.
    pulls : the first Piola-Kirchhoff stress along each axis in kPa, (3,).
    axes : the axes (u,) of the stretches that minimise the energy; 3 for none.
    last : the axis of the stretch that keeps the volume; None where it may change.
    """
    dofs = axes < 3
    closes = jnp.zeros(3, dtype=bool) if last is None else jnp.arange(3) == last

    def gradient(d: jax.Array) -> jax.Array:
        stretched = H.at[axes, axes].set(d, mode="drop")
        if last is None:
            return stretched
        F = stretched + jnp.diag(jnp.where(closes, 0.0, 1.0))  # its last stretch is zero
        along = cofactor(F)[last]
        closing = (1.0 - jnp.vdot(F[last], along)) / along[last] - 1.0
        return stretched + jnp.diag(jnp.where(closes, closing, 0.0))

    free = closes.at[axes].set(True, mode="drop")
    held = jnp.prod(jnp.where(free, 1.0, 1.0 + jnp.diagonal(H)))
    start = jnp.where(dofs, held ** (-1.0 / jnp.maximum(jnp.sum(free), 1)) - 1.0, 0.0)
    if not len(start):
        return gradient(start), jnp.array(True)
    slope_of = jax.jacfwd(gradient)  # (3, 3, u)

    def potential(d: jax.Array) -> jax.Array:
        H = gradient(d)
        return point.energy(H, tissue) - jnp.vdot(pulls, jnp.diagonal(H))

    def linearised(d: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return energy, slope (u,) and stiffness (u, u) in the stretches along ``axes``."""
        H = gradient(d)
        stress, moduli = point.moduli(H, tissue)
        stress = stress - jnp.diag(pulls)
        along = slope_of(d)
        stiffness = jnp.einsum("ija,ijkl,klb->ab", along, moduli, along)
        if last is not None:  # the stretch that keeps the volume is no linear function of d
            stiffness += jnp.einsum("ij,ijab->ab", stress, jax.jacfwd(slope_of)(d))
        stiffness = jnp.where(dofs[:, None] & dofs, stiffness, jnp.diag(jnp.where(dofs, 0.0, 1.0)))
        slope = jnp.where(dofs, jnp.einsum("ij,ija->a", stress, along), 0.0)
        return potential(d), slope, stiffness

    if len(guesses):  # exponential laws overshoot in strain: begin near a pull's equilibrium
        along = jnp.where(dofs, jnp.append(pulls, 0.0)[jnp.minimum(axes, 3)], 0.0)
        along = along / jnp.maximum(jnp.max(jnp.abs(along)), jnp.finfo(along.dtype).tiny)
        tried = start + (1.0 + start) * jnp.asarray(guesses)[:, None] * along
        energies = jax.vmap(potential)(tried)
        start = tried[jnp.argmin(jnp.where(jnp.isfinite(energies), energies, jnp.inf))]
    end = jax.lax.stop_gradient(minimise_by_newton(linearised, start, low=-1.0))
    # One more step, whose stiffness is a constant, has the derivative of the equilibrium.
    stress = jax.grad(point.energy)(gradient(end.x), tissue) - jnp.diag(pulls)
    slope = jnp.where(dofs, jnp.einsum("ij,ija->a", stress, slope_of(end.x)), 0.0)
    step = solve_modified(end.hessian, slope)
    converged = end.converged & jnp.all(jnp.isfinite(step))
    return gradient(end.x - jnp.where(converged, step, 0.0)), converged


def homogeneous(
    scene: Specimen, *, incompressible: bool = False, executor: Any = None
) -> Homogeneous:
    """Return the states of the specimen ``scene`` as a forward map, see :class:`Homogeneous`.

    executor : as of other solvers, without effect: all states are one program of milliseconds.
    """
    del executor
    return Homogeneous(scene, all_nodes(scene), incompressible)


HOMOGENEOUS = ForwardKind(
    "homogeneous",
    "states of a specimen, without a mesh",
    lambda ingredients, _: homogeneous(require_specimen(ingredients.scene)),
    closer="",
    anywhere=True,
)
INCOMPRESSIBLE = ForwardKind(
    "incompressible",
    "the same, without changes of volume",
    lambda ingredients, _: homogeneous(require_specimen(ingredients.scene), incompressible=True),
    closer="--forward homogeneous",
    anywhere=True,
)
