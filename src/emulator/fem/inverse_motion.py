r"""Inverse motion: equilibrium on a known loaded shape, for the way back to the stress-free one.

The mesh of the scene, x, is loaded; the unknown is the displacement w to the stress-free shape
X = x + w (Govindjee & Mihalic 1996, Comput. Methods Appl. Mech. Engng 136, 47-57). With
:math:`h = \partial w/\partial x`, elements at X are mapped to those at x by

.. math::
    f = I + h, \qquad F = f^{-1}, \qquad H = F - I = -F h, \qquad dX = \det f\, dx,

so that the equations of the scene on the mesh X, at the displacement u = -w, are

.. math::
    r_a(w) = \sum_q \omega_q\, \sigma(f)\, \nabla_x N_a - f_a^\text{ext}(w) = 0,
    \qquad \sigma = \det f\; \tau, \qquad \tau = P(F)\, F^T

at free nodes, to round-off: loading the mesh X leads to x. :math:`\omega_q` are the quadrature
weights of x, :math:`\tau` is the Kirchhoff and :math:`\sigma` the Cauchy stress. A pressure acts on
the known shape and does not depend on w; weight and dead tractions are given per volume and area at
rest and do. Prescribed displacements are zero.

Directions m of the loaded tissue are carried back as material lines, :math:`f_0 = f m / |f m|`.
Sheets are carried back likewise and then turned to be orthogonal to the fibres, in the plane of
both: laws are written for orthogonal ones. The derivative of the stress is

.. math::
    d\tau = \left(\frac{\partial P}{\partial F} : dF
        + \frac{\partial P}{\partial f_0} \cdot df_0\right) F^T + P\, dF^T ,

where only F and :math:`f_0` are differentiated along all nine components of h, never the law. Where
points have volume ratios of their own, with :math:`A = \partial\sigma/\partial h`,

.. math::
    K_{ab} = \sum_q \omega_q\, \nabla N_a \cdot A\, \nabla N_b .

With mean dilatation, and with v and V the volumes of a block at x and at X,

.. math::
    r_a = \sum_q \omega_q \left(\det f\, \operatorname{dev} \hat\tau + p I\right) \nabla_x N_a,
    \qquad \theta = \frac{v}{V} = \frac{\sum_q \omega_q}{\sum_q \omega_q \det f},
    \qquad p = \frac{1}{3v} \sum_q \omega_q \det f\, \operatorname{tr} \hat\tau,

:math:`\hat\tau` being the law's Kirchhoff stress at :math:`\hat F = (\theta \det f)^{1/3} F`.
:math:`\theta` and p are unknowns, eliminated block by block by the equations of
:mod:`emulator.fem.condensation`, with :math:`f = r`, :math:`s = v - \theta V`,
:math:`C = -\theta V_w`, :math:`q = p(w, \theta) - p`, :math:`Q = p_w`, :math:`h = p_\theta`,
:math:`f_p = \sum \omega \nabla N` and
:math:`f_\theta = \sum \omega \det f \operatorname{dev} \hat\tau_\theta \nabla N`.

The tangent is not symmetric, and the solution is no minimum: natural monotonicity judges steps
(:mod:`emulator.fem.formulations.mean_dilatation`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.assembly import System
from emulator.fem.condensation import (
    Condensed,
    Couplings,
    Residuals,
    Volumes,
    block_gradients,
    block_integral,
    block_volume,
    per_point,
    volume_change,
)
from emulator.fem.energy import (
    DeadForce,
    at_points,
    nodal_vectors,
    pair_matrices,
    point_energy,
    with_volume_change,
)
from emulator.fem.material_point import stress_and_moduli
from emulator.mechanics.kinematics import cofactor, determinant
from emulator.scenes.part import LocalForce, LocalTerm
from emulator.scenes.scene import Scene

# One material point


def carried_back(h: jax.Array, directions: jax.Array | None) -> jax.Array | None:
    """Return the directions (3,) or (2, 3) at rest from the loaded tissue's directions."""
    if directions is None:
        return None
    f = h + jnp.eye(3, dtype=h.dtype)
    if directions.ndim == 1:
        return _unit(f @ directions)
    fibre, sheet = _unit(f @ directions[0]), f @ directions[1]
    return jnp.stack([fibre, _unit(sheet - jnp.vdot(sheet, fibre) * fibre)])


def from_rest(h: jax.Array) -> jax.Array:
    """Return the displacement gradient ``H = F - I`` (3, 3) from rest, without loss of digits."""
    f = h + jnp.eye(3, dtype=h.dtype)
    return -(cofactor(f).T / determinant(f)) @ h


def _seen_by_law(
    directions: jax.Array | None, h: jax.Array, *change: jax.Array
) -> tuple[jax.Array, jax.Array | None]:
    """Return gradient and directions from rest; ``change`` is a block's volume ratio less 1."""
    H = from_rest(h)
    return with_volume_change(H, change[0]) if change else H, carried_back(h, directions)


def cauchy(scene: Scene, theta: jax.Array) -> Callable[..., jax.Array]:
    """Return ``(h, *change, tissue) -> det f tau (3, 3)`` in kPa, as the module docstring has it.

    change : the volume ratio less 1, where a block shares one.
    """
    energy = point_energy(scene, theta)

    def stress(*x: Any) -> jax.Array:
        *point, at = x
        H, directions = _seen_by_law(at.directions, *point)
        P = jax.grad(energy)(H, at._replace(directions=directions))
        return _det(point[0]) * (P @ (H + jnp.eye(3, dtype=H.dtype)).T)

    return stress


def cauchy_and_slopes(scene: Scene, theta: jax.Array) -> Callable[..., tuple[jax.Array, ...]]:
    """Return :func:`cauchy` with its derivatives in h and, where given, in the change."""
    law, energy = stress_and_moduli(scene, theta), point_energy(scene, theta)

    def linearised(*x: Any) -> tuple[jax.Array, ...]:
        *point, at = x
        seen = partial(_seen_by_law, at.directions)
        H, directions = seen(*point)
        H_slopes, turns = jax.jacfwd(seen, tuple(range(len(point))))(*point)
        F = H + jnp.eye(3, dtype=H.dtype)
        P, A = law(H, at._replace(directions=directions))
        in_H = jnp.einsum("ijkl,mj->imkl", A, F) + jnp.einsum("il,mk->imkl", P, jnp.eye(3))
        slopes = [jnp.tensordot(in_H, slope, 2) for slope in H_slopes]
        if directions is not None:
            stress_along = lambda d: jax.grad(energy)(H, at._replace(directions=d)) @ F.T  # noqa: E731
            turned = jax.jacfwd(stress_along)(directions)
            turning = [jnp.tensordot(turned, turn, directions.ndim) for turn in turns]
            slopes = [one + other for one, other in zip(slopes, turning, strict=True)]
        tau, (det, det_slope) = P @ F.T, jax.value_and_grad(_det)(point[0])
        in_h, *in_change = (det * slope for slope in slopes)
        return det * tau, in_h + tau[:, :, None, None] * det_slope, *in_change

    return linearised


def _unit(vector: jax.Array) -> jax.Array:
    return vector / jnp.sqrt(jnp.sum(vector**2))


def _det(h: jax.Array) -> jax.Array:
    return determinant(h + jnp.eye(3, dtype=h.dtype))


# Blocks


def block_forces(scene: Scene, w: jax.Array, theta: jax.Array) -> jax.Array:
    """Return the forces (b, a, 3) in mN of the blocks' stresses at ``w`` (n, 3) mm."""
    volumes = consistent(scene, w, theta)
    if isinstance(volumes, Volumes):
        return residuals(scene, w, volumes, theta).force
    h = block_gradients(scene, w)
    stress = at_points(cauchy(scene, theta), h, scene.block_tissue_at(theta))
    return nodal_vectors(scene.blocks, stress)


def consistent(scene: Scene, w: jax.Array, theta: jax.Array) -> Volumes | tuple[()]:
    """Return the volumes and pressures that follow from ``w``; () where points have their own."""
    if scene.dilatation == "pointwise":
        return ()
    h = block_gradients(scene, w)
    det_less_1 = at_points(volume_change, h)  # v/V - 1 without loss of digits
    change = -block_integral(scene, det_less_1) / block_integral(scene, 1.0 + det_less_1)
    return Volumes(change, _pressure(scene, _stress(scene, h, change, theta)))


def linearise(
    scene: Scene, w: jax.Array, volumes: Volumes | tuple[()], theta: jax.Array
) -> Condensed:
    """Return the force and tangent of every block at ``w`` (n, 3) mm and ``volumes``."""
    grid, h, tissue = scene.blocks, block_gradients(scene, w), scene.block_tissue_at(theta)
    law = cauchy_and_slopes(scene, theta)
    if not isinstance(volumes, Volumes):
        stress, moduli = at_points(law, h, tissue)
        return Condensed(nodal_vectors(grid, stress), _matrices(scene, moduli))
    stress, in_h, in_change = at_points(law, h, per_point(h, volumes.change), tissue)
    trace_h, v = jnp.einsum("bqiikl->bqkl", in_h), block_volume(scene)
    K = _matrices(scene, in_h - jnp.einsum("ij,bqkl->bqijkl", jnp.eye(3) / 3.0, trace_h))
    V, V_w = block_integral(scene, at_points(_det, h)), at_points(jax.grad(_det), h)
    C = -(1.0 + volumes.change)[:, None, None] * nodal_vectors(grid, V_w)
    Q = nodal_vectors(grid, trace_h) / (3.0 * v)[:, None, None]
    slope = block_integral(scene, _trace(in_change)) / (3.0 * v)
    onto_change = nodal_vectors(grid, _deviator(in_change))
    onto_pressure = nodal_vectors(grid, jnp.broadcast_to(jnp.eye(3), h.shape))
    along = C / V[:, None, None]
    K = K + _outer(onto_change, along) + _outer(onto_pressure, Q + slope[:, None, None] * along)
    at = _residuals(scene, h, volumes, stress)
    couplings = Couplings(at, V, C, Q, slope, onto_change, onto_pressure)
    return Condensed(couplings.eliminated(at), K, couplings)


def residuals(scene: Scene, w: jax.Array, volumes: Volumes, theta: jax.Array) -> Residuals:
    """Return the residuals of every block at ``w`` (n, 3) mm and ``volumes``."""
    h = block_gradients(scene, w)
    return _residuals(scene, h, volumes, _stress(scene, h, volumes.change, theta))


def _residuals(scene: Scene, h: jax.Array, volumes: Volumes, stress: jax.Array) -> Residuals:
    """Return the residuals from the law's :func:`cauchy` stress (b, q, 3, 3) in kPa."""
    V = block_integral(scene, at_points(_det, h))
    S = _deviator(stress) + volumes.pressure[:, None, None, None] * jnp.eye(3)
    return Residuals(
        nodal_vectors(scene.blocks, S),
        block_volume(scene) - (1.0 + volumes.change) * V,
        _pressure(scene, stress) - volumes.pressure,
    )


def _stress(scene: Scene, h: jax.Array, change: jax.Array, theta: jax.Array) -> jax.Array:
    """Return the law's :func:`cauchy` stress (b, q, 3, 3) where blocks share a volume ratio."""
    return at_points(cauchy(scene, theta), h, per_point(h, change), scene.block_tissue_at(theta))


def _pressure(scene: Scene, stress: jax.Array) -> jax.Array:
    """Return ``p(w, theta)`` (b,) in kPa."""
    return block_integral(scene, _trace(stress)) / (3.0 * block_volume(scene))


def _matrices(scene: Scene, moduli: jax.Array) -> jax.Array:
    """Return matrices (b, 3a, 3a) from derivatives (b, q, 3, 3, 3, 3) of the stress in h."""
    count = scene.blocks.connectivity.shape[1]
    one, other = np.indices((count, count))
    pairs = pair_matrices(scene.blocks, moduli, (one.ravel(), other.ravel()))
    wide = pairs.reshape(-1, count, count, 3, 3).transpose(0, 1, 3, 2, 4)
    return wide.reshape(-1, 3 * count, 3 * count)


def _outer(one: jax.Array, other: jax.Array) -> jax.Array:
    """Return the outer products (b, 3a, 3a) of vectors (b, a, 3)."""
    return jax.vmap(jnp.outer)(one, other)


def _trace(stress: jax.Array) -> jax.Array:
    return jnp.trace(stress, axis1=-2, axis2=-1)


def _deviator(stress: jax.Array) -> jax.Array:
    return stress - _trace(stress)[..., None, None] * jnp.eye(3) / 3.0


# The system


class InverseSystem(System):
    """The equations of inverse motion of a scene whose mesh is its loaded shape.

    The unknown is w, from the loaded shape to the stress-free one. The forces of loads and elastic
    supports are those of their ``on_loaded``.
    """

    inverse: ClassVar[bool] = True

    @cached_property
    def springs(self) -> list[LocalForce]:
        """Elastic supports on the loaded shape."""
        grid = self.scene.discretisation
        return [force for support in self.scene.supports for force in support.on_loaded(grid)]

    @cached_property
    def terms(self) -> list[LocalTerm]:
        """No potentials; see :attr:`forces`."""
        return []

    @cached_property
    def dead(self) -> DeadForce:
        """No force: all loads are in :attr:`forces`."""
        return DeadForce(np.zeros(self.scene.held.shape), {})

    @cached_property
    def forces(self) -> list[LocalForce]:
        """Loads on the loaded shape."""
        grid, fibres = self.scene.discretisation, self.scene.fibres_of_loads
        return [force for load in self.scene.loads for force in load.on_loaded(grid, fibres)]

    def internal_force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the force (n, 3) in mN of the stresses and of the springs."""
        bulk = self.scatter(block_forces(self.scene, u, theta))
        return bulk - self.spring_force(u, theta)

    def bulk(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the derivatives (b, 3a, 3a) of the blocks' forces in w, mN/mm."""
        volumes = consistent(self.scene, u, theta)
        return linearise(self.scene, u, volumes, theta).tangent
