r"""The stress-free shape of a body that is known under load, as in an image.

Two methods find the displacement w from the loaded mesh x to the stress-free one, x + w. Both find
the root of the equations that the scene has on the mesh x + w, so that loading it meets the mesh x
to round-off, and w has the derivatives of that root in theta.

``inverse`` solves equilibrium on the known shape for w (:mod:`emulator.fem.inverse_motion`), in
about as many iterations as a solve takes.

``fixed_point`` loads trial shapes repeatedly (Sellier 2011, Int. J. Comput. Methods 8, 463-474). It
corrects w by the distance of the shape x + w, once loaded, from x,

.. math::
    R_k = w_k + u(x + w_k), \qquad w_{k+1} = w_k - \beta_k R_k, \qquad
    \beta_k = -\beta_{k-1} \frac{R_{k-1} \cdot (R_k - R_{k-1})}{|R_k - R_{k-1}|^2}

with Aitken's relaxation (Rausch, Genet & Humphrey 2017, J. Biomech. 58, 227-231). An iteration is a
solve on a mesh of its own, by one program for all of them (:func:`system_at_rest`).

On the mesh x + w, with :math:`f = I + \partial w/\partial x`, shape functions have the gradients
:math:`f^{-T} \nabla_x N` and quadrature points the weights :math:`\det f\, \omega`; directions are
carried back as material lines (:func:`emulator.fem.inverse_motion.carried_back`).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.core.machine import require_float64
from emulator.fem.assembly import System
from emulator.fem.compiled import while_loop
from emulator.fem.derivatives import (
    Equations,
    RootFinder,
    SolutionMap,
    differentiable,
    equations_of,
    require_finite,
    sensitivities,
)
from emulator.fem.energy import at_points, require_rest, require_shape
from emulator.fem.fallbacks import find_equilibrium
from emulator.fem.inverse_motion import InverseSystem, carried_back
from emulator.fem.newton import NewtonOptions, largest_admissible
from emulator.fem.solution import Solution, Status
from emulator.geometry.discretisation import Blocks
from emulator.geometry.mesh import signed_volumes
from emulator.mechanics.kinematics import cofactor, determinant
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue

# Constants of the fixed-point iteration.
_MOST_CORRECTIONS = 100
_TOLERANCE = 1e-11  # largest distance from the loaded shape to the mesh, over the body's size
_SHORTEST = 2.0**-6  # least fraction of a correction
_RELAXATION = (0.1, 2.0)  # bounds of Aitken's relaxation


@dataclass(frozen=True, eq=False)
class Unloaded:
    """The stress-free shape of a body; arrays gain leading axes under ``vmap``.

    displacement : the displacement w (n, 3) in mm from the loaded mesh to the stress-free one; when
        not converged, at the fraction ``load_reached`` of the loads.
    status, iterations, factorisations, residual, load_reached : as in a
        :class:`~emulator.fem.solution.Solution`.
    loaded : the scene on the loaded mesh.
    theta : the parameters (p,), with the loads that the mesh is under.
    """

    displacement: jax.Array
    status: jax.Array
    iterations: jax.Array
    factorisations: jax.Array
    residual: jax.Array
    load_reached: jax.Array
    loaded: Scene
    theta: jax.Array

    @property
    def converged(self) -> jax.Array:
        """Whether the status is CONVERGED."""
        return self.status == Status.CONVERGED

    @property
    def start(self) -> jax.Array:
        """The displacement (n, 3) in mm that loads the stress-free mesh again."""
        return -self.displacement

    @cached_property
    def scene(self) -> Scene:
        """The scene on the stress-free mesh, with the same sets, law, loads, supports and theta.

        Fibres and sheets are carried back with the tissue. For numbers, not under ``jit``.

        Raises
        ------
        SolverError
            Not converged.
        InputError
            An element of the stress-free mesh is inverted.
        """
        return scene_at_rest(self.loaded, self.require_converged().displacement)

    @property
    def taken_off(self) -> dict[str, tuple[float, str]]:
        """Amount and unit of each load that was taken off, by its name; for numbers."""
        values, share = self.loaded.resolve(self.theta), float(self.load_reached)
        return {
            (*load.quantities, load.magnitude)[0].name: (
                share * float(load.value(values)),
                load.magnitude.unit,
            )
            for load in self.loaded.loads
            if load.magnitude is not None
        }

    @property
    def limit(self) -> str:
        """How much of the load could be taken off, in words; for numbers."""
        amounts = ", ".join(f"{name} {x:.3g} {unit}" for name, (x, unit) in self.taken_off.items())
        of_it = f" ({amounts})" if amounts else ""
        return f"up to {100.0 * self.load_reached:.3g} % of the load{of_it} could be taken off"

    def require_converged(self, what: str = "unloading") -> Unloaded:
        """Return itself, or raise :class:`~emulator.core.errors.SolverError` naming the failure."""
        limit = self.limit if self.status.ndim == 0 else None
        Solution(*(getattr(self, name) for name in Solution._fields)).require_converged(what, limit)
        return self


jax.tree_util.register_dataclass(
    Unloaded, data_fields=[*Solution._fields, "theta"], meta_fields=["loaded"]
)


@dataclass(frozen=True, eq=False)
class Unloader:
    """Finds the stress-free shapes of a scene whose mesh is loaded, at any theta.

    Use it alone, under ``jit``, ``vmap`` or ``grad``; it is compiled once for all theta.

    Parameters
    ----------
    scene : the scene, whose mesh and directions of tissue are those under load.
    method : ``inverse`` or ``fixed_point``; the former needs about a tenth of the factorisations
        (docs/experiments.md, "Unloading").
    options : the controls of Newton's method.

    Raises
    ------
    InputError
        Supports that move, a load that no body can be unloaded from, or an unknown method.
    """

    scene: Scene
    method: str = "inverse"
    options: NewtonOptions = field(default_factory=NewtonOptions)

    def __post_init__(self) -> None:
        look_up(METHODS, self.method, "method of unloading")
        require_rest(self.scene)
        if self.scene.prescribed.moves:
            raise InputError(
                f"scene '{self.scene.name}': a support moves the body, so that its mesh is not "
                "the loaded shape; hold nodes at 0 mm to unload it"
            )
        try:
            self.system.forces  # noqa: B018 - raises for loads that no body can be unloaded from
        except InputError as error:
            raise InputError(f"scene '{self.scene.name}': {error}") from error

    @cached_property
    def system(self) -> InverseSystem:
        """The equations of inverse motion."""
        return InverseSystem(self.scene)

    def solve(self, theta: jax.Array) -> Unloaded:
        """Return the stress-free shape; ``theta`` (p,) has the loads that the mesh is under.

        A failure is no exception: read ``status``. Differentiable in ``theta``.

        Raises
        ------
        InputError
            ``theta`` has the wrong shape, or float64 is off.
        """
        require_float64("FEM")
        theta = jnp.asarray(theta, dtype=float)
        require_shape(self.scene, "theta", theta, (len(self.scene.parameters),))
        solution = self._solution(theta, jnp.zeros(self.scene.held.shape))
        solution = jax.block_until_ready(solution)
        return Unloaded(**solution._asdict(), loaded=self.scene, theta=theta)

    def sensitivities(self, unloaded: Unloaded, theta: jax.Array) -> jax.Array:
        """Return the derivatives (p, n, 3) of ``unloaded.displacement`` in each entry of ``theta``.

        One factor serves them all. For numbers.

        Raises
        ------
        SolverError
            The tangent is singular.
        """
        rows = sensitivities(self.system, unloaded.displacement, jnp.asarray(theta, dtype=float))
        return require_finite(self.scene, rows, "the stress-free shape")

    def equations(self, w: jax.Array, theta: jax.Array) -> tuple[Equations]:
        """Return the equations whose root is ``w`` (n, 3) mm, the way to the stress-free shape."""
        return (equations_of(self.system, w, theta),)

    @cached_property
    def _solution(self) -> SolutionMap:
        return differentiable(self.system, self.options, METHODS[self.method])


def unload(scene: Scene, theta: jax.Array, **options: Any) -> Unloaded:
    """Return the stress-free shape of ``scene``, whose mesh is its shape under load at ``theta``.

    For many theta of a scene make one :class:`Unloader`, which is compiled once.

    Parameters
    ----------
    scene : the scene on its loaded mesh.
    theta : the parameters (p,), with the pressure under which the image was taken; they may lie
        outside the scene's box.
    options : the fields ``method`` and ``options`` of an :class:`Unloader`.

    Raises
    ------
    InputError
        Supports that move, a load that no body can be unloaded from, an unknown method.
    """
    return Unloader(scene, **options).solve(theta)


# Methods


def _by_inverse_motion(
    system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array
) -> Solution:
    """Solve the equations of inverse motion from ``start``, which is the loaded mesh."""
    without_stress_iterates = replace(options, stress_iterates=False)
    return find_equilibrium(system, without_stress_iterates, theta, start)


def _by_fixed_point(
    system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array
) -> Solution:
    """Load trial shapes until the loaded one is the mesh, from ``start`` (n, 3) mm."""
    tolerance = _TOLERANCE * system.scene.mesh.size

    def correct(state: _FixedPointState) -> _FixedPointState:
        trial = system_at_rest(system, state.w, theta)
        loaded = find_equilibrium(trial, options, theta, state.loaded.displacement)
        distance = state.w + loaded.displacement
        change = distance - state.distance
        size = jnp.sum(change**2)
        relaxation = -state.relaxation * jnp.vdot(state.distance, change)
        relaxation = jnp.clip(relaxation / jnp.where(size > 0.0, size, 1.0), *_RELAXATION)
        relaxation = jnp.where(state.corrections > 0, relaxation, 1.0)
        step = -relaxation * distance
        admissible = system.keeps_volume(state.w, step, options.shrink)
        fraction = largest_admissible(admissible, _SHORTEST)
        exhausted = state.corrections + 1 >= _MOST_CORRECTIONS
        status = jnp.where(exhausted, Status.ITERATION_LIMIT, Status.RUNNING)
        status = jnp.where(fraction > 0.0, status, Status.INVERTED_ELEMENT)
        status = jnp.where(jnp.max(jnp.abs(distance)) <= tolerance, Status.CONVERGED, status)
        status = jnp.where(loaded.status == Status.CONVERGED, status, loaded.status)
        return _FixedPointState(
            w=jnp.where(status == Status.RUNNING, state.w + fraction * step, state.w),
            distance=distance,
            relaxation=relaxation,
            corrections=state.corrections + 1,
            loaded=loaded._replace(
                status=jnp.asarray(status, dtype=jnp.int64),
                iterations=state.loaded.iterations + loaded.iterations,
                factorisations=state.loaded.factorisations + loaded.factorisations,
            ),
        )

    count, zero = jnp.zeros((), dtype=int), jnp.zeros(())
    running = jnp.asarray(Status.RUNNING, dtype=jnp.int64)
    at_start = Solution(-start, running, count, count, zero, zero)
    first = _FixedPointState(start, jnp.zeros_like(start), jnp.ones(()), count, at_start)
    state = while_loop(lambda state: state.loaded.status == Status.RUNNING, correct, first)
    converged = state.loaded.converged
    w = jnp.where(converged, state.w, 0.0)
    residual, load_reached = system.relative_residual(w, theta), jnp.where(converged, 1.0, 0.0)
    return state.loaded._replace(displacement=w, residual=residual, load_reached=load_reached)


class _FixedPointState(NamedTuple):
    """The state of the fixed-point iteration.

    w : the displacement to the trial shape, (n, 3) mm.
    distance : the distance R at the last correction, (n, 3) mm.
    relaxation : the relaxation beta of the last correction, ().
    corrections : the number of corrections.
    loaded : the last solution on a trial shape, with the iterations of all and the status of this
        iteration.
    """

    w: jax.Array
    distance: jax.Array
    relaxation: jax.Array
    corrections: jax.Array
    loaded: Solution


METHODS: dict[str, RootFinder] = {"inverse": _by_inverse_motion, "fixed_point": _by_fixed_point}
"""The methods of unloading, by name."""


# The scene on its stress-free mesh


def tissue_at_rest(scene: Scene, w: jax.Array, theta: jax.Array) -> Tissue:
    """Return the material data (m, q, ...) on the mesh x + w, directions carried back."""
    tissue, h = scene.tissue_at(theta), scene.gradients(w)
    return tissue._replace(directions=at_points(carried_back, h, tissue.directions))


def scene_at_rest(scene: Scene, w: jax.Array) -> Scene:
    """Return ``scene`` on the mesh x + w, for numbers: sets, law, loads, supports and theta stay.

    Raises
    ------
    InputError
        An element is inverted there, or theta turns the fibres.
    """
    if scene.angles:
        raise InputError(
            f"scene '{scene.name}': theta turns its fibres, so the unloaded body is no scene of "
            "its own; give their angles as numbers"
        )
    directions = tissue_at_rest(scene, w, scene.centre).directions
    fibres = sheets = None
    if directions is not None:
        values = np.asarray(directions)
        fibres, sheets = (values, None) if values.ndim == 3 else (values[:, :, 0], values[:, :, 1])
    nodes, corners = scene.mesh.nodes + np.asarray(w), scene.mesh.corners
    if inverted := int((signed_volumes(nodes, corners) <= 0.0).sum()):
        raise InputError(
            f"scene '{scene.name}': {inverted} of {len(corners)} elements of the stress-free mesh "
            "are inverted at their corners, where no stress is evaluated; mesh with rounder "
            "elements, or let a map unload the body (loaded_by), which needs no such mesh"
        )
    mesh = replace(scene.mesh, nodes=nodes)
    # No rule made these directions, and no name says how the mesh was made.
    return replace(scene, mesh=mesh, fibres=fibres, sheets=sheets, fibre_rule=None, origin={})


def system_at_rest(system: System, w: jax.Array, theta: jax.Array) -> System:
    """Return the equations of :func:`scene_at_rest` for ``w`` and ``theta`` that may be traced.

    They live as long as the function that makes them, and nothing is checked.
    """
    scene, tissue = system.scene, tissue_at_rest(system.scene, w, theta)
    directions, h = tissue.directions, scene.gradients(w)
    fibres = directions if directions is None or directions.ndim == 3 else directions[:, :, 0]
    mesh = unchecked(scene.mesh, nodes=scene.mesh.nodes + w)
    gradients, weights = _shape_functions_at_rest(scene.discretisation, h)
    grid = replace(scene.discretisation, mesh=mesh, gradients=gradients, weights=weights)
    blocks: Blocks = grid
    if scene.dilatation == "patch":
        gradients, weights = _shape_functions_at_rest(scene.blocks, scene.blocks.gather(h))
        blocks = replace(scene.blocks, gradients=gradients, weights=weights)
    at_rest = unchecked(
        scene,
        mesh=mesh,
        discretisation=grid,
        blocks=blocks,
        fibres=fibres,
        angles=(),  # theta has turned the fibres already
        _tissue=tissue,
        _block_tissue=jax.tree.map(blocks.gather, tissue),
    )
    rest_system = System(at_rest)
    # Evaluated here, so that no program inside another keeps what depends on its own tracers.
    _ = rest_system.springs, rest_system.terms, rest_system.forces, rest_system.dead
    return rest_system


def unchecked[T](thing: T, **values: Any) -> T:
    """Return a frozen dataclass with other ``values``, which may be traced."""
    view = copy.copy(thing)
    vars(view).update(values)
    return view


def _shape_functions_at_rest(blocks: Blocks, h: jax.Array) -> tuple[Any, Any]:
    """Return gradients (b, q, a, 3) and weights (b, q) at x + w, from ``h`` (b, q, 3, 3)."""
    f = h + jnp.eye(3, dtype=h.dtype)
    det = at_points(determinant, f)
    inverse_transposed = at_points(cofactor, f) / det[..., None, None]
    gradients = jnp.einsum("bqij,bqaj->bqai", inverse_transposed, blocks.gradients)
    return gradients, blocks.weights * det
