r"""Static condensation of mean dilatation: the volume and pressure of each block are eliminated.

A block is a quadratic element, or a patch of linear ones
(:class:`~emulator.geometry.discretisation.Patches`).

With displacements alone, a stiff volume term limits Newton's steps to where the constraint is
nearly linear: hundreds of tiny steps at nu = 0.4999 (docs/experiments.md, "Mean dilatation on the
displacements alone"). So the volume ratio :math:`\theta` and pressure :math:`p` of each block
become unknowns (Simo, Taylor & Pister 1985), stationary points of

.. math::
    L = \sum_e E_e(u, \theta_e) + p_e V_e \left[\bar J_e(u) - \theta_e\right], \qquad
    E_e(u, \theta) = \sum_q w_q\, W\!\left((\theta / J_q)^{1/3} F_q\right).

With :math:`g = E_{u\theta}`, :math:`b = V \bar J_u`, :math:`r_\theta = E_\theta - pV` and
:math:`r_p = V(\bar J - \theta)`, the two are eliminated block by block,

.. math::
    V \Delta\theta &= s + C \cdot \Delta u, \qquad
    \Delta p = q + Q \cdot \Delta u + h\, \Delta\theta \\
    K_e &= f_u + f_\theta \otimes C/V + f_p \otimes (Q + h\, C/V), \qquad
    f_e = f + f_\theta\, s/V + f_p\, (q + h\, s/V)

with the force :math:`f = L_u`, :math:`f_\theta = g`, :math:`f_p = C = b`, :math:`s = r_p`,
:math:`q = r_\theta/V`, :math:`Q = g/V` and :math:`h = E_{\theta\theta}/V`. Where
:math:`\theta = \bar J(u)` and :math:`p = E_\theta/V` these are the force and the tangent of the
energy in u alone, so both formulations have the same solutions.

With :math:`\hat H(H, \theta)` the gradient that the law sees, and :math:`\hat P` and
:math:`\hat A` the law's stress and moduli there,

.. math::
    W_{xx} = \hat H_x^T\, \hat A\, \hat H_x + \hat P\, \hat H_{xx}, \qquad x = (H, \theta).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.energy import (
    at_points,
    nodal_vectors,
    pair_matrices,
    point_energy,
    with_volume_change,
)
from emulator.fem.material_point import stress_and_moduli
from emulator.mechanics.kinematics import Strain
from emulator.scenes.scene import Scene


class Volumes(NamedTuple):
    """The unknowns of the blocks.

    change : the volume ratio less 1, (b,).
    pressure : the pressure in kPa, (b,).
    """

    change: jax.Array
    pressure: jax.Array


class Residuals(NamedTuple):
    """The force f (b, a, 3) in mN, s (b,) in mm3 and q (b,) in kPa of the module docstring."""

    force: jax.Array
    change: jax.Array
    pressure: jax.Array


class Couplings(NamedTuple):
    """The coefficients that eliminate the volumes and pressures, as in the module docstring.

    residuals : the residuals of the iterate.
    V : the volumes, (b,) mm3.
    C, Q : the derivatives (b, a, 3) of s and q in the displacement.
    h : the derivative (b,) of q in the volume ratio, kPa.
    onto_change, onto_pressure : the derivatives (b, a, 3) of the force in either.
    """

    residuals: Residuals
    V: jax.Array
    C: jax.Array
    Q: jax.Array
    h: jax.Array
    onto_change: jax.Array
    onto_pressure: jax.Array

    def eliminated(self, at: Residuals) -> jax.Array:
        """Return ``f_e`` (b, a, 3) for the residuals of this iterate or of another.

        Those of another and the tangent of this one give the simplified Newton step.
        """
        change = at.change / self.V
        pressure = at.pressure + self.h * change
        force = at.force + change[:, None, None] * self.onto_change
        return force + pressure[:, None, None] * self.onto_pressure

    def advance(self, volumes: Volumes, step: jax.Array, fraction: jax.Array) -> Volumes:
        """Return ``volumes`` after ``fraction`` of the blocks' full ``step`` (b, a, 3) mm."""
        along_C, along_Q = (jnp.einsum("bai,bai->b", slope, step) for slope in (self.C, self.Q))
        change = (self.residuals.change + along_C) / self.V
        pressure = self.residuals.pressure + along_Q + self.h * change
        return Volumes(volumes.change + fraction * change, volumes.pressure + fraction * pressure)


class Condensed(NamedTuple):
    """The linearisation of the blocks, volumes eliminated where they share one.

    force : the nodal forces of the blocks, (b, a, 3) mN.
    tangent : the stiffness of the blocks in mN/mm, as the pattern of the equations has it.
    couplings : the coefficients of the elimination; None without shared volumes.
    """

    force: jax.Array
    tangent: jax.Array
    couplings: Couplings | None = None


def block_derivatives(
    scene: Scene, u: jax.Array, stress: jax.Array, moduli: jax.Array, known: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """Return the forces (b, a, 3) in mN and tangents (b, pairs, 3, 3) in mN/mm of the blocks.

    scene : the scene.
    u : the displacement, (n, 3) mm.
    stress, moduli : the first (b, q, 3, 3) and second (b, q, 3, 3, 3, 3) derivatives of the energy
        density in the displacement gradients that the law sees, kPa.
    known : the stress whose geometric stiffness the tangents have; by default ``stress``.
    """
    if scene.dilatation == "pointwise":
        return nodal_vectors(scene.blocks, stress), pair_matrices(scene.blocks, moduli)
    H = block_gradients(scene, u)
    change = _mean_change(scene, H)

    def condensed(stress: jax.Array) -> Condensed:
        slope = lambda *x: jax.vjp(with_volume_change, *x[:2])[1](x[2])[1]  # noqa: E731
        slopes = at_points(slope, H, per_point(H, change), stress)
        volumes = Volumes(change, block_integral(scene, slopes) / block_volume(scene))
        return _condensed(scene, H, volumes, stress, moduli)

    linearised = condensed(stress)
    return linearised.force, (linearised if known is None else condensed(known)).tangent


def consistent(scene: Scene, u: jax.Array, theta: jax.Array) -> Volumes:
    """Return the volumes and pressures that follow from the displacement ``u`` (n, 3)."""
    H = block_gradients(scene, u)
    change = _mean_change(scene, H)
    slope = _slopes(scene, H, change, theta)[1]
    return Volumes(change, block_integral(scene, slope) / block_volume(scene))


def linearise(scene: Scene, u: jax.Array, volumes: Volumes, theta: jax.Array) -> Condensed:
    """Return the force and tangent of every block at ``u`` (n, 3) mm and ``volumes``."""
    H, law = block_gradients(scene, u), stress_and_moduli(scene, theta)
    response = lambda H, change, at: law(with_volume_change(H, change), at)  # noqa: E731
    change, tissue = per_point(H, volumes.change), scene.block_tissue_at(theta)
    return _condensed(scene, H, volumes, *at_points(response, H, change, tissue))


def residuals(scene: Scene, u: jax.Array, volumes: Volumes, theta: jax.Array) -> Residuals:
    """Return the residuals of every block at ``u`` (n, 3) mm and ``volumes``."""
    H = block_gradients(scene, u)
    return _residuals(scene, H, volumes, *_slopes(scene, H, volumes.change, theta))


def _condensed(
    scene: Scene, H: jax.Array, volumes: Volumes, stress: jax.Array, moduli: jax.Array
) -> Condensed:
    """Return the linearisation, from the law's derivatives in the gradients that it sees."""
    grid, V = scene.blocks, block_volume(scene)
    change = per_point(H, volumes.change)
    P, slope, A, coupling, curvature = at_points(_second, H, change, stress, moduli)
    r = _residuals(scene, H, volumes, P, slope)
    p = volumes.pressure[:, None, None, None, None, None]
    A = A + p * at_points(jax.hessian(volume_change), H)
    b = nodal_vectors(grid, at_points(jax.grad(volume_change), H))
    g, h = nodal_vectors(grid, coupling), block_integral(scene, curvature) / V
    # g b^T/V + b g^T/V + h b b^T/V for each pair of nodes, as a half and its transpose.
    half = (g + 0.5 * h[:, None, None] * b) / V[:, None, None]
    one, other = np.triu_indices(b.shape[1])
    outer = half[:, one, :, None] * b[:, other, None, :] + b[:, one, :, None] * half[:, other, None]
    couplings = Couplings(r, V, b, g / V[:, None, None], h, g, b)
    return Condensed(couplings.eliminated(r), pair_matrices(grid, A) + outer, couplings)


def _second(
    H: jax.Array, change: jax.Array, P: jax.Array, A: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]:
    """Return both first and the three second derivatives in ``H`` and ``change``.

    P, A : the derivatives (3, 3), (3, 3, 3, 3) in the gradient that the law sees.
    """
    in_H, in_change = jax.jacfwd(with_volume_change, (0, 1))(H, change)
    curvature = jax.hessian(lambda *x: jnp.vdot(P, with_volume_change(*x)), (0, 1))(H, change)
    stress = jnp.tensordot(A, in_change, 2)
    return (
        jnp.tensordot(P, in_H, 2),
        jnp.vdot(P, in_change),
        jnp.tensordot(in_H, jnp.tensordot(A, in_H, 2), ((0, 1), (0, 1))) + curvature[0][0],
        jnp.tensordot(stress, in_H, 2) + curvature[0][1],
        jnp.vdot(in_change, stress) + curvature[1][1],
    )


def _slopes(
    scene: Scene, H: jax.Array, change: jax.Array, theta: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the derivatives (b, q, 3, 3), (b, q) of the density in ``H`` and ``change``, kPa."""
    energy = point_energy(scene, theta)
    density = lambda H, change, at: energy(with_volume_change(H, change), at)  # noqa: E731
    tissue = scene.block_tissue_at(theta)
    return at_points(jax.grad(density, (0, 1)), H, per_point(H, change), tissue)


def _residuals(
    scene: Scene, H: jax.Array, volumes: Volumes, P: jax.Array, slope: jax.Array
) -> Residuals:
    """Return the residuals from the density's derivatives in ``H`` and in the volumes."""
    V, p = block_volume(scene), volumes.pressure
    change, cofactor = at_points(jax.value_and_grad(volume_change), H)
    return Residuals(
        nodal_vectors(scene.blocks, P + p[:, None, None, None] * cofactor),
        block_integral(scene, change) - V * volumes.change,
        block_integral(scene, slope) / V - p,
    )


def per_point(H: jax.Array, change: jax.Array) -> jax.Array:
    """Return ``change`` (b,) of the blocks at each of their points, (b, q)."""
    return jnp.broadcast_to(change[:, None], H.shape[:2])


def volume_change(H: jax.Array) -> jax.Array:
    """Return ``J - 1`` of a displacement gradient (3, 3)."""
    return Strain(H).J_minus_1


def _mean_change(scene: Scene, H: jax.Array) -> jax.Array:
    """Return the mean ``J - 1`` (b,) of each block."""
    return block_integral(scene, at_points(volume_change, H)) / block_volume(scene)


def block_integral(scene: Scene, density: jax.Array) -> jax.Array:
    """Return the integral (b,) over each block of ``density`` (b, q)."""
    return jnp.sum(scene.blocks.weights * density, axis=1)


def block_volume(scene: Scene) -> jax.Array:
    """Return the volume (b,) of each block of the mesh, mm3."""
    return jnp.sum(jnp.asarray(scene.blocks.weights), axis=1)


def block_gradients(scene: Scene, u: jax.Array) -> jax.Array:
    """Return the displacement gradient (b, q, 3, 3) at the blocks' points."""
    return scene.blocks.gather(scene.gradients(u))
