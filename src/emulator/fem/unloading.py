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

from emulator.core.errors import InputError, SolverError, look_up
from emulator.core.machine import require_float64
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled, while_loop
from emulator.fem.derivatives import (
    Equations,
    RootFinder,
    SolutionMap,
    differentiable,
    sensitivities,
)
from emulator.fem.energy import displacement_gradient, require_rest
from emulator.fem.fallbacks import find_equilibrium
from emulator.fem.inverse_motion import InverseSystem, carried_back
from emulator.fem.line_search import largest_admissible
from emulator.fem.linear import find_solver
from emulator.fem.newton import NewtonOptions
from emulator.fem.solution import Solution, Status
from emulator.geometry.discretisation import Blocks
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
    """

    displacement: jax.Array
    status: jax.Array
    iterations: jax.Array
    factorisations: jax.Array
    residual: jax.Array
    load_reached: jax.Array
    loaded: Scene

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

    def require_converged(self, what: str = "unloading") -> Unloaded:
        """Return itself, or raise :class:`~emulator.core.errors.SolverError` naming the failure."""
        Solution(*(getattr(self, name) for name in Solution._fields)).require_converged(what)
        return self


jax.tree_util.register_dataclass(
    Unloaded, data_fields=list(Solution._fields), meta_fields=["loaded"]
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
    factorisation : the linear solver, as for a :class:`~emulator.fem.simulator.Simulator`.

    Raises
    ------
    InputError
        Supports that move, a load that no body can be unloaded from, or an unknown method.
    """

    scene: Scene
    method: str = "inverse"
    options: NewtonOptions = field(default_factory=NewtonOptions)
    factorisation: str = "suitesparse"

    def __post_init__(self) -> None:
        find_solver(self.factorisation)
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
        return InverseSystem(self.scene, self.factorisation)

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
        if theta.shape != (len(self.scene.parameters),):
            raise InputError(
                f"scene '{self.scene.name}': theta has shape {theta.shape}; expected "
                f"{(len(self.scene.parameters),)}"
            )
        solution = self._solution(theta, jnp.zeros(self.scene.held.shape))
        return Unloaded(**jax.block_until_ready(solution)._asdict(), loaded=self.scene)

    def sensitivities(self, unloaded: Unloaded, theta: jax.Array) -> jax.Array:
        """Return the derivatives (p, n, 3) of ``unloaded.displacement`` in each entry of ``theta``.

        One factor serves them all. For numbers.

        Raises
        ------
        SolverError
            The tangent is singular.
        """
        w, theta = unloaded.displacement, jnp.asarray(theta, dtype=float)
        rows = sensitivities(self.system, self.system.safe_tangent(w, theta)[0], w, theta)
        if not np.isfinite(rows).all():
            raise SolverError(
                f"scene '{self.scene.name}': the stress-free shape has no derivatives: singular "
                "tangent"
            )
        return rows

    def equations(self, w: jax.Array, theta: jax.Array) -> tuple[Equations]:
        """Return the equations whose root is ``w`` (n, 3) mm, the way to the stress-free shape."""
        tangent = self.system.safe_tangent(w, theta)[0]
        return (
            Equations(self.system, w, tangent, lambda theta, w: self.system.residual(w, theta)),
        )

    @cached_property
    def _solution(self) -> SolutionMap:
        return differentiable(self.system, self.options, METHODS[self.method])


def unload(
    scene: Scene,
    theta: jax.Array,
    *,
    method: str = "inverse",
    options: NewtonOptions = NewtonOptions(),
    factorisation: str = "suitesparse",
) -> Unloaded:
    """Return the stress-free shape of ``scene``, whose mesh is its shape under load at ``theta``.

    For many theta of a scene make one :class:`Unloader`, which is compiled once.

    Parameters
    ----------
    scene : the scene on its loaded mesh.
    theta : the parameters (p,), with the pressure under which the image was taken; they may lie
        outside the scene's box.
    method, options, factorisation : see :class:`Unloader`.

    Raises
    ------
    InputError
        Supports that move, a load that no body can be unloaded from, an unknown method.
    """
    return Unloader(scene, method, options, factorisation).solve(theta)


# Methods


def _by_inverse_motion(
    system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array
) -> Solution:
    """Solve the equations of inverse motion from ``start``, which is the loaded mesh."""
    without_stress_iterates = replace(options, stress_iterates=False)
    solution = find_equilibrium(system, without_stress_iterates, theta, start)
    return _check_corners(system, solution)


def _by_fixed_point(
    system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array
) -> Solution:
    """Load trial shapes until the loaded one is the mesh, from ``start`` (n, 3) mm."""
    tolerance = _TOLERANCE * system.scene.mesh.size

    def correct(state: _FixedPointState) -> _FixedPointState:
        trial = system_at_rest(system, state.w, theta)
        loaded = find_equilibrium(trial, options, theta, state.u)
        load_converged = loaded.status == Status.CONVERGED
        distance = state.w + loaded.displacement
        relaxation = _aitken(state, distance)
        step = -relaxation * distance
        floor = options.shrink * system.least_volume_ratio(state.w)
        fraction = largest_admissible(
            lambda part: floor < system.least_volume_ratio(state.w + part * step), _SHORTEST
        )
        converged = jnp.max(jnp.abs(distance)) <= tolerance
        exhausted = state.corrections + 1 >= _MOST_CORRECTIONS
        status = jnp.where(exhausted, Status.ITERATION_LIMIT, Status.RUNNING)
        status = jnp.where(fraction > 0.0, status, Status.INVERTED_ELEMENT)
        status = jnp.where(converged, Status.CONVERGED, status)
        status = jnp.where(load_converged, status, loaded.status)
        running = status == Status.RUNNING
        return _FixedPointState(
            w=jnp.where(running, state.w + fraction * step, state.w),
            u=loaded.displacement,
            distance=distance,
            relaxation=relaxation,
            corrections=state.corrections + 1,
            iterations=state.iterations + loaded.iterations,
            factorisations=state.factorisations + loaded.factorisations,
            status=jnp.asarray(status, dtype=jnp.int64),
        )

    count, running = jnp.zeros((), dtype=int), jnp.asarray(Status.RUNNING, dtype=jnp.int64)
    first = _FixedPointState(
        start, -start, jnp.zeros_like(start), jnp.ones(()), count, count, count, running
    )
    state = while_loop(lambda state: state.status == Status.RUNNING, correct, first)
    converged = state.status == Status.CONVERGED
    w = jnp.where(converged, state.w, 0.0)
    solution = Solution(
        displacement=w,
        status=state.status,
        iterations=state.iterations,
        factorisations=state.factorisations,
        residual=system.relative_residual(w, theta),
        load_reached=jnp.where(converged, 1.0, 0.0),
    )
    return _check_corners(system, solution)


class _FixedPointState(NamedTuple):
    """The state of the fixed-point iteration.

    w : the displacement to the trial shape, (n, 3) mm.
    u : the displacement that loads it, (n, 3) mm.
    distance : the distance R at the last correction, (n, 3) mm.
    relaxation : the relaxation beta of the last correction, ().
    corrections : the number of corrections.
    iterations, factorisations : the totals over all solves.
    status : a :class:`Status`.
    """

    w: jax.Array
    u: jax.Array
    distance: jax.Array
    relaxation: jax.Array
    corrections: jax.Array
    iterations: jax.Array
    factorisations: jax.Array
    status: jax.Array


def _aitken(state: _FixedPointState, distance: jax.Array) -> jax.Array:
    """Return the relaxation () of the next correction; 1 at the first."""
    change = distance - state.distance
    size = jnp.sum(change**2)
    divisor = jnp.where(size > 0.0, size, 1.0)
    relaxation = -state.relaxation * jnp.vdot(state.distance, change) / divisor
    return jnp.where(state.corrections > 0, jnp.clip(relaxation, *_RELAXATION), 1.0)


def _check_corners(system: System, solution: Solution) -> Solution:
    """Return ``solution``, failed if an element of the stress-free mesh is inverted at its corners.

    A quadratic element may be inverted there and not at its quadrature points.
    """
    inverted = ~(_least_corner_volume(system, solution.displacement) > 0.0)
    inverted &= solution.status == Status.CONVERGED
    status = jnp.where(inverted, Status.INVERTED_ELEMENT, solution.status)
    return solution._replace(status=status.astype(solution.status.dtype))


@compiled
def _least_corner_volume(system: System, w: jax.Array) -> jax.Array:
    """Return the least volume () in mm3 that the corners of an element enclose at x + w."""
    mesh = system.scene.mesh
    corners = (mesh.nodes + w)[mesh.corners]
    edges = corners[:, 1:] - corners[:, :1]
    return jnp.min(jax.vmap(determinant)(edges)) / 6.0


METHODS: dict[str, RootFinder] = {"inverse": _by_inverse_motion, "fixed_point": _by_fixed_point}
"""The methods of unloading, by name."""


# The scene on its stress-free mesh


def tissue_at_rest(scene: Scene, w: jax.Array, theta: jax.Array) -> Tissue:
    """Return the material data (m, q, ...) on the mesh x + w, directions carried back."""
    tissue = scene.tissue_at(theta)
    if tissue.directions is None:
        return tissue
    h = displacement_gradient(scene, w)
    directions = jax.vmap(jax.vmap(carried_back))(h, jnp.asarray(tissue.directions))
    return tissue._replace(directions=directions)


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
    mesh = replace(scene.mesh, nodes=scene.mesh.nodes + np.asarray(w))
    # No rule made these directions, and no name says how the mesh was made.
    return replace(scene, mesh=mesh, fibres=fibres, sheets=sheets, fibre_rule=None, origin={})


def system_at_rest(system: System, w: jax.Array, theta: jax.Array) -> System:
    """Return the equations of the scene on the mesh x + w, for arrays that may be traced."""
    rest_system = System(_traced_scene_at_rest(system.scene, w, theta), system.factorisation)
    # Evaluated here, so that no program inside another keeps what depends on its own tracers.
    _ = rest_system.springs, rest_system.terms, rest_system.forces, rest_system.dead
    return rest_system


def _traced_scene_at_rest(scene: Scene, w: jax.Array, theta: jax.Array) -> Scene:
    """Return :func:`scene_at_rest` for ``w`` (n, 3) and ``theta`` (p,) that may be traced.

    Its fibres are already turned by ``theta``. It lives as long as the function that makes
    it, and nothing is checked.
    """
    grid, tissue = scene.discretisation, tissue_at_rest(scene, w, theta)
    directions = tissue.directions
    fibres = directions if directions is None or directions.ndim == 3 else directions[:, :, 0]
    mesh = copy.copy(scene.mesh)
    object.__setattr__(mesh, "nodes", scene.mesh.nodes + w)
    h = displacement_gradient(scene, w)
    gradients, weights = _shape_functions_at_rest(grid, h)
    rest_grid = replace(grid, mesh=mesh, gradients=gradients, weights=weights)
    blocks: Blocks = rest_grid
    if scene.dilatation == "patch":
        gradients, weights = _shape_functions_at_rest(scene.blocks, scene.blocks.gather(h))
        blocks = replace(scene.blocks, gradients=gradients, weights=weights)
    view = copy.copy(scene)
    for name, value in (
        ("mesh", mesh),
        ("discretisation", rest_grid),
        ("blocks", blocks),
        ("fibres", fibres),
        ("angles", ()),
        ("_tissue", tissue),
        ("_block_tissue", jax.tree.map(blocks.gather, tissue)),
    ):
        object.__setattr__(view, name, value)
    return view


def _shape_functions_at_rest(blocks: Blocks, h: jax.Array) -> tuple[Any, Any]:
    """Return gradients (b, q, a, 3) and weights (b, q) at x + w, from ``h`` (b, q, 3, 3)."""
    f = h + jnp.eye(3, dtype=h.dtype)
    det = jax.vmap(jax.vmap(determinant))(f)
    inverse_transposed = jax.vmap(jax.vmap(cofactor))(f) / det[..., None, None]
    gradients = jnp.einsum("bqij,bqaj->bqai", inverse_transposed, blocks.gradients)
    return gradients, blocks.weights * det
