r"""The stress-free shape of a body that is known under load, as in an image.

Two methods look for the displacement w from the loaded mesh to the stress-free one. ``inverse``
solves the equilibrium on the known shape for w (:mod:`emulator.fem.inverse`), in about as many
iterations as a solve; ``fixed_point`` loads guesses again and again
(:mod:`emulator.fem.fixed_point`). Both find the root of the equations that the scene has on the
mesh x + w, so that loading it meets the mesh to round-off, and w has the derivatives of that root
in theta, whichever method found it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, SolverError, look_up
from emulator.core.precision import require_float64
from emulator.fem.balance import relative_residual
from emulator.fem.continuation import find_equilibrium
from emulator.fem.energy import require_rest
from emulator.fem.fixed_point import find_by_loading
from emulator.fem.implicit import Equations, Find, Found, derivatives, differentiable
from emulator.fem.inverse import InverseSystem
from emulator.fem.linear import find_solver
from emulator.fem.loop import compiled
from emulator.fem.moved import at_rest
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Solution, Status
from emulator.fem.system import System
from emulator.mechanics.kinematics import determinant
from emulator.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class Unloaded:
    """A body without its loads; arrays gain leading axes under ``vmap``.

    displacement : w (n, 3) in mm, from the loaded mesh to the stress-free one; when not converged,
        at the fraction ``load_reached`` of the loads.
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
        """The scene on the stress-free mesh: sets, law, loads, supports and theta are equal.

        Fibres and sheets are carried back with the tissue. For numbers, not under ``jit``.

        Raises
        ------
        SolverError
            Not converged.
        InputError
            The stress-free mesh is folded.
        """
        return at_rest(self.loaded, self.require_converged().displacement)

    def require_converged(self, what: str = "unloading") -> Unloaded:
        """Itself, or :class:`~emulator.core.errors.SolverError` naming the failure."""
        Solution(*(getattr(self, name) for name in Solution._fields)).require_converged(what)
        return self


jax.tree_util.register_dataclass(
    Unloaded, data_fields=list(Solution._fields), meta_fields=["loaded"]
)


@dataclass(frozen=True, eq=False)
class Unloader:
    """Stress-free shapes of a scene whose mesh is loaded, at any theta.

    Use it alone, under ``jit``, ``vmap`` or ``grad``; compiled once for all theta.

    Parameters
    ----------
    scene : its mesh, and the directions of its tissue, are those under load.
    method : ``inverse`` or ``fixed_point``; by default the former, which needs about a tenth of the
        factorisations (docs/experiments.md, "Unloading").
    options : controls of Newton's method.
    factorisation : as for a :class:`~emulator.fem.simulator.Simulator`.

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
            self.system.forces  # noqa: B018 - loads that cannot be taken off are named first
        except InputError as error:
            raise InputError(f"scene '{self.scene.name}': {error}") from error

    @cached_property
    def system(self) -> InverseSystem:
        """Residual and tangent of the inverse motion."""
        return InverseSystem(self.scene, self.factorisation)

    def solve(self, theta: jax.Array) -> Unloaded:
        """The stress-free shape at ``theta`` (p,), which has the loads that the mesh is under.

        Never raises on a hard case: read ``status``. Differentiable in ``theta``.

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
        nowhere = jnp.zeros(self.scene.held.shape)
        return Unloaded(*self._found(theta, nowhere), loaded=self.scene)

    def sensitivities(self, unloaded: Unloaded, theta: jax.Array) -> jax.Array:
        """Derivatives (p, n, 3) of ``unloaded.displacement`` in each entry of ``theta`` (p,).

        One factor serves them all. For numbers.

        Raises
        ------
        SolverError
            The tangent is singular.
        """
        w, theta = unloaded.displacement, jnp.asarray(theta, dtype=float)
        found = derivatives(self.system, self.system.safe_tangent(w, theta)[0], w, theta)
        if not np.isfinite(found).all():
            raise SolverError(
                f"scene '{self.scene.name}': the stress-free shape has no derivatives: singular "
                "tangent"
            )
        return found

    def equations(self, w: jax.Array, theta: jax.Array) -> tuple[Equations]:
        """What the displacement ``w`` (n, 3) mm to the stress-free shape solves."""
        tangent = self.system.safe_tangent(w, theta)[0]
        return (
            Equations(self.system, w, tangent, lambda theta, w: self.system.residual(w, theta)),
        )

    @cached_property
    def _found(self) -> Found:
        return differentiable(self.system, self.options, METHODS[self.method])


def unload(
    scene: Scene,
    theta: jax.Array,
    *,
    method: str = "inverse",
    options: NewtonOptions = NewtonOptions(),
    factorisation: str = "suitesparse",
) -> Unloaded:
    """The stress-free shape of ``scene``, whose mesh is its shape under the loads of ``theta``.

    For many theta of a scene make one :class:`Unloader`, which is compiled once.

    Parameters
    ----------
    theta : (p,), with the pressure under which the image was taken; not held to the scene's box.
    method, options, factorisation : see :class:`Unloader`.

    Raises
    ------
    InputError
        Supports that move, a load that no body can be unloaded from, an unknown method.
    """
    return Unloader(scene, method, options, factorisation).solve(theta)


def _by_inverse_motion(
    system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array
) -> Solution:
    """From ``start``, which is the loaded mesh, at the whole load, then load level by level."""
    plain = replace(options, stress_iterates=False)
    return _upright(system, find_equilibrium(system, plain, theta, start))


def _by_loading(
    system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array
) -> Solution:
    found = find_by_loading(system, options, theta, start)
    error = relative_residual(system, found.displacement, theta)
    return _upright(system, found._replace(residual=error))


def _upright(system: System, found: Solution) -> Solution:
    """``found``, its failure named where an element of the stress-free mesh is upside down.

    A quadratic one may be between its quadrature points.
    """
    least = _least_volume(system, found.displacement)
    wrong = (found.status == Status.CONVERGED) & ~(least > 0.0)
    status = jnp.where(wrong, Status.INVERTED_ELEMENT, found.status)
    return found._replace(status=status.astype(found.status.dtype))


METHODS: dict[str, Find] = {"inverse": _by_inverse_motion, "fixed_point": _by_loading}
"""Ways to the stress-free shape, by name."""


@compiled
def _least_volume(system: System, w: jax.Array) -> jax.Array:
    """Least volume () in mm3 that the corners of an element enclose at x + w."""
    mesh = system.scene.mesh
    corners = (mesh.nodes + w)[mesh.corners]
    edges = corners[:, 1:] - corners[:, :1]
    return jnp.min(jax.vmap(determinant)(edges)) / 6.0
