r"""The error of the mesh: the difference between solutions on the mesh and on a finer one.

An equilibrium :math:`u_h` on a mesh of size h, and one on the next finer mesh
(:mod:`emulator.scenes.finer`), differ by

.. math:: u_h - u_{h/2} = (u_h - u)\,(1 - 2^{-k}), \qquad |u_h - u| \sim h^k ,

most of the error: seven eighths at :math:`k = 3`, the rate of quadratic elements on smooth
solutions, a half at :math:`k = 1`, as at the edge of a clamp; from linear to quadratic elements
nearly all of it. So the difference has an effectivity of one half to one.

No solve from rest is needed. The iteration on the finer mesh starts from the prolonged solution,
plus a combination of the differences :math:`D_i` found at other theta, with the weights

.. math:: \min_w \; \Big|\sum_i w_i u_i - u\Big|^2 + 10^{-4}\, \overline{|u_i|^2}\, |w|^2

with which the solutions on the mesh come closest to this one. What the finer mesh adds follows the
deformation, whatever tissue and load it is of: for small displacements it is linear in it.
Without a known difference, the prolonged solution is far from balance: inside a coarse element only
the mean strain is balanced, and strains vary about it. So two stress iterates
(:mod:`emulator.fem.stress_iterates`) begin with the mean strain measures of each coarse element.
A Newton step is checked by a second back-substitution
(:func:`emulator.accuracy.estimate.newton_distance`), and another step follows if what the second
leaves is much. Where steps do not contract, as far from any known deformation, they are tried once
more after stress iterates, and then FEM solves on the finer mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from threading import Lock
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.accuracy.estimate import Distance, newton_distance
from emulator.core.engine import STAYS
from emulator.core.errors import InputError
from emulator.core.gaussian_process import Regression
from emulator.fem.compiled import compiled
from emulator.fem.linear.suitesparse import free_factors, on_all_cores
from emulator.fem.simulator import Simulator
from emulator.fem.stress_iterates import StressIterates, applies
from emulator.scenes.finer import Finer, finer
from emulator.scenes.scene import Scene

LARGEST = 60_000
"""Nodes of the largest finer mesh that is solved on; beyond, a factorisation takes a minute."""

_TOLERANCE = 1e-7  # solves on the finer mesh: far below the meshes' difference
_LEFT = 0.02  # largest share of the meshes' difference that the last step may leave
_DIVERGENCE = 0.5  # contraction of a step above which FEM solves instead
_RIDGE = 1e-4  # of the weights of known solutions, in their mean square
_STEPS = 3  # largest number of steps
_STRESS_STEPS = 2  # stress iterates before them, where they would not contract

Quantity = Callable[[jax.Array, jax.Array], jax.Array]


class MeshErrorEstimate(NamedTuple):
    """The error of the mesh at one theta.

    theta : (p,). coarse : (n, 3) mm, the equilibrium on the mesh.
    fine : (f, 3) mm, the equilibrium on the finer mesh, whose first n nodes are the mesh's.
    solved : whether FEM solved on the finer mesh because steps did not contract.
    """

    theta: jax.Array
    coarse: jax.Array
    fine: jax.Array
    solved: bool

    @property
    def field(self) -> jax.Array:
        """Displacement on the mesh less displacement on the finer one, at the mesh's nodes, mm."""
        return self.coarse - self.fine[: len(self.coarse)]

    @property
    def err_u(self) -> jax.Array:
        """Length of :attr:`field` at each node, (n,) mm."""
        return jnp.linalg.norm(self.field, axis=1)

    def of(self, on_mesh: Quantity, on_finer: Quantity) -> jax.Array:
        """Return the error of a quantity ``q(u, theta)`` defined on both meshes, in its unit."""
        return on_mesh(self.coarse, self.theta) - on_finer(self.fine, self.theta)


@dataclass(frozen=True, eq=False)
class MeshError:
    """Errors of a simulator's mesh; made by :func:`mesh_error`.

    Threads may share one whose simulator they may share (:func:`emulator.fem.campaign.at_once`):
    steps on the finer mesh are taken at once, solves there, which may keep a factor, one by one.

    fine : the simulator on the finer mesh.
    """

    simulator: Simulator
    finer: Finer
    fine: Simulator
    _alone: Lock = field(default_factory=Lock, repr=False, metadata={STAYS: True})

    def __call__(
        self,
        theta: jax.Array,
        start: jax.Array | None = None,
        *,
        known: Sequence[MeshErrorEstimate] = (),
    ) -> MeshErrorEstimate:
        """Estimate the error at ``theta`` (p,).

        Parameters
        ----------
        start : the start of the solve on the mesh, (n, 3) mm; the state at rest by default.
        known : estimates at other theta, whose differences between the meshes begin the iteration.

        Raises
        ------
        SolverError
            No equilibrium was found on one of the meshes.
        """
        theta = jnp.asarray(theta, dtype=float)
        what = "the error of the mesh"
        coarse = self.simulator.solve(theta, start).require_converged(what).displacement
        prolonged = jnp.asarray(self.finer.refinement.carry(coarse))
        begin = self._combined(coarse, known) if known else prolonged
        # A step solves one set of equations; a scene whose mesh is the loaded shape has two.
        if not self.fine.scene.loaded_by:
            has_stresses = applies(self.fine.scene)
            with on_all_cores(begin.size):
                is_near = bool(known) or not has_stresses
                fine = self._steps(theta, begin, prolonged) if is_near else None
                if fine is None and has_stresses:
                    fine = self._steps(theta, self._nearer(theta, begin), prolonged)
            if fine is not None:
                return MeshErrorEstimate(theta, coarse, fine, solved=False)
        with self._alone:
            solution = self.fine.solve(theta, begin)
            if not solution.converged:  # strains of locked elements may be too rough a start
                solution = self.fine.solve(theta)
        fine = solution.require_converged(f"{what}, on the finer one").displacement
        return MeshErrorEstimate(theta, coarse, fine, solved=True)

    def _combined(self, coarse: jax.Array, known: Sequence[MeshErrorEstimate]) -> jax.Array:
        """Return the combination (f, 3) mm of ``known`` solutions that is closest to ``coarse``.

        The remainder of ``coarse`` is prolonged.
        """
        # In NumPy: JAX would compile a program for each number of them.
        solutions, u = np.stack([np.asarray(o.coarse) for o in known]), np.asarray(coarse)
        weights = _weights(solutions.reshape(len(known), -1), u.ravel())
        on_finer = np.tensordot(weights, np.stack([other.fine for other in known]), 1)
        left = u - np.tensordot(weights, solutions, 1)
        return jnp.asarray(on_finer + self.finer.refinement.carry(left))

    def forget(self) -> None:
        """Free all factors that are kept: a large mesh's are gigabytes, and would stay."""
        free_factors()

    def _nearer(self, theta: jax.Array, begin: jax.Array) -> jax.Array:
        """Return the displacement (f, 3) mm after stress iterates from ``begin``.

        It is ``begin`` itself where a tangent is indefinite.
        """
        system = self.fine.system
        iterates = StressIterates(system, self.fine.options.shrink, theta, jnp.ones(()))
        state = iterates.begin(begin)
        every = state.measures  # (m, q, k); the children of a coarse element follow each other
        points = self.finer.refinement.children * every.shape[1]
        of_parents = every.reshape(-1, points, every.shape[2])
        means = jnp.broadcast_to(of_parents.mean(axis=1, keepdims=True), of_parents.shape)
        state = state._replace(measures=means.reshape(every.shape))
        for _ in range(_STRESS_STEPS):
            state = iterates.step(state, jnp.ones(()))
            if not bool(state.definite):
                return begin
        return state.u

    @cached_property
    def _step(self) -> Callable[[jax.Array, jax.Array], Distance]:
        return compiled(partial(newton_distance, self.fine.system))

    def _steps(self, theta: jax.Array, u: jax.Array, prolonged: jax.Array) -> jax.Array | None:
        """Take a few steps from ``u`` (f, 3) on the finer mesh; None if they do not contract.

        They end where what they leave, the contraction times the last step, is a small share of the
        difference from the coarse solution ``prolonged`` (f, 3).
        """
        for _ in range(_STEPS):
            step = self._step(u, theta)
            if not float(step.contraction) <= _DIVERGENCE:
                return None
            u = u - step.error
            left = step.contraction * jnp.abs(step.error).max()
            if step.accepted and float(left) <= _LEFT * float(jnp.abs(u - prolonged).max()):
                return u
        return None


def _weights(known: np.ndarray, u: np.ndarray) -> np.ndarray:
    r"""Return the weights (k,) with which known solutions (k, 3n) come closest to ``u`` (3n,).

    At the minimum :math:`(U U^T + 10^{-4}\, \overline{|u_i|^2} I)\, w = U u`: regression with a
    linear kernel.
    """
    K = known @ known.T
    ridge = _RIDGE * max(float(np.diag(K).mean()), np.finfo(float).tiny)
    return Regression.of(K + ridge * np.eye(len(known))).weights(known @ u)


def mesh_error(simulator: Simulator | Scene, *, most: int = LARGEST) -> MeshError:
    """Make error estimates for the mesh of ``simulator``, or of a scene solved with the defaults.

    Parameters
    ----------
    most : the largest number of nodes of the finer mesh.

    Raises
    ------
    InputError
        A finer mesh of more nodes, or a load that it cannot have.
    """
    coarse = simulator if isinstance(simulator, Simulator) else Simulator(simulator)
    refined = finer(coarse.scene)
    if (count := len(refined.scene.mesh.nodes)) > most:
        raise InputError(
            f"mesh error: the mesh finer than that of '{coarse.scene.name}' has {count} nodes, "
            f"more than {most}; allow more with 'most', or check a coarser mesh of the same body"
        )
    options = replace(coarse.options, tolerance=max(coarse.options.tolerance, _TOLERANCE))
    return MeshError(coarse, refined, Simulator(refined.scene, options))
