r"""Static condensation of mean dilatation: the volume and pressure of each block are eliminated.

A block is a quadratic element, or a patch of linear ones (:mod:`emulator.geometry.patches`).

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
    V \Delta\theta &= r_p + b^T \Delta u, \qquad
    V \Delta p = r_\theta + g^T \Delta u + E_{\theta\theta}\, \Delta\theta \\
    K_e &= E_{uu} + p V \bar J_{uu} + (g b^T + b g^T)/V + E_{\theta\theta}\, b b^T/V^2 \\
    f_e &= E_u + p b + g\, r_p/V + b\,(r_\theta + E_{\theta\theta}\, r_p/V)/V .

Where :math:`\theta = \bar J(u)` and :math:`p = E_\theta/V` these are the force and the tangent of
the energy in u alone, so both formulations have the same solutions.

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
    displacement_gradient,
    nodal_vectors,
    pair_matrices,
    point_energy,
    with_volume_change,
)
from emulator.fem.material_point import stress_and_moduli
from emulator.mechanics.kinematics import Strain
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue


class Volumes(NamedTuple):
    """The unknowns of the blocks.

    change : the volume ratio less 1, (b,).
    pressure : the pressure in kPa, (b,).
    """

    change: jax.Array
    pressure: jax.Array


class Couplings(NamedTuple):
    """The coefficients that eliminate the volumes and pressures, as in the module docstring.

    b, g : the couplings (b, a, 3) with the displacement.
    r_change, r_pressure : the residuals (b,) of volumes and pressures.
    stiffness : the second derivative (b,) of the energy in the volumes.
    """

    b: jax.Array
    g: jax.Array
    r_change: jax.Array
    r_pressure: jax.Array
    stiffness: jax.Array


class Condensed(NamedTuple):
    """The linearisation with the volumes eliminated.

    force : the nodal forces of the blocks, (b, a, 3) mN.
    tangent : the stiffness of the blocks, (b, pairs, 3, 3) mN/mm.
    couplings : the coefficients of the elimination.
    """

    force: jax.Array
    tangent: jax.Array
    couplings: Couplings


class _Residuals(NamedTuple):
    """The derivatives of ``L`` in u (b, a, 3), in the volumes (b,), and in the pressures (b,)."""

    force: jax.Array
    change: jax.Array
    pressure: jax.Array


def block_derivatives(
    scene: Scene,
    u: jax.Array,
    stress: jax.Array,
    moduli: jax.Array,
    known: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Return the forces (b, a, 3) in mN and tangents (b, pairs, 3, 3) in mN/mm of the blocks.

    Parameters
    ----------
    scene : the scene.
    u : the displacement, (n, 3) mm.
    stress, moduli : the first (b, q, 3, 3) and second (b, q, 3, 3, 3, 3) derivatives of the energy
        density in the displacement gradients that the law sees, kPa.
    known : the stress whose geometric stiffness the tangents have; by default ``stress``.
    """
    if scene.dilatation == "pointwise":
        return nodal_vectors(scene.blocks, stress), pair_matrices(scene.blocks, moduli)
    H, V = block_gradients(scene, u), _volume(scene)
    change = _mean_change(scene, H)

    def condensed(stress: jax.Array) -> Condensed:
        slope = _at_points(_first, H, change, stress)[1]
        volumes = Volumes(change, block_integral(scene, slope) / V)
        return _condensed(scene, H, volumes, stress, moduli)

    linearised = condensed(stress)
    return linearised.force, (linearised if known is None else condensed(known)).tangent


def consistent(scene: Scene, u: jax.Array, theta: jax.Array) -> Volumes:
    """Return the volumes and pressures that follow from the displacement ``u`` (n, 3)."""
    H = block_gradients(scene, u)
    change = _mean_change(scene, H)
    slope = _slopes(scene, H, change, theta)[1]
    return Volumes(change, block_integral(scene, slope) / _volume(scene))


def linearise(scene: Scene, u: jax.Array, volumes: Volumes, theta: jax.Array) -> Condensed:
    """Return the force and tangent of every block at ``u`` (n, 3) mm and ``volumes``."""
    H, law = block_gradients(scene, u), stress_and_moduli(scene, theta)
    response = lambda H, change, at: law(with_volume_change(H, change), at)  # noqa: E731
    stress, moduli = at_points(
        response, scene.block_tissue_at(theta), H, per_point(H, volumes.change)
    )
    return _condensed(scene, H, volumes, stress, moduli)


def eliminated_force(
    scene: Scene, u: jax.Array, volumes: Volumes, theta: jax.Array, couplings: Couplings
) -> jax.Array:
    """Return the force (b, a, 3) of every block at ``u``, eliminated with earlier ``couplings``.

    It is the force of :func:`linearise`, but with the couplings of an earlier iterate: solving with
    that iterate's tangent gives the simplified Newton step.
    """
    H = block_gradients(scene, u)
    P, slope = _slopes(scene, H, volumes.change, theta)
    return _eliminated(scene, _residuals(scene, H, volumes, P, slope), couplings)


def advance(
    scene: Scene, volumes: Volumes, couplings: Couplings, step: jax.Array, fraction: jax.Array
) -> Volumes:
    """Return ``volumes`` after ``fraction`` of the full ``step`` (n, 3) mm."""
    local = step[scene.blocks.connectivity]
    at, V = couplings, _volume(scene)
    change = (at.r_pressure + jnp.einsum("mai,mai->m", at.b, local)) / V
    pressure = at.r_change + jnp.einsum("mai,mai->m", at.g, local) + at.stiffness * change
    return Volumes(volumes.change + fraction * change, volumes.pressure + fraction * pressure / V)


def _condensed(
    scene: Scene, H: jax.Array, volumes: Volumes, stress: jax.Array, moduli: jax.Array
) -> Condensed:
    """Return the linearisation, from the law's derivatives in the gradients that it sees."""
    grid, V = scene.blocks, _volume(scene)
    P, slope, A, coupling, curvature = _at_points(_second, H, volumes.change, stress, moduli)
    r = _residuals(scene, H, volumes, P, slope)
    p = volumes.pressure[:, None, None, None, None, None]
    A = A + p * _over_points(jax.hessian(volume_change), H)
    b = nodal_vectors(grid, _over_points(jax.grad(volume_change), H))
    g, stiffness = nodal_vectors(grid, coupling), block_integral(scene, curvature)
    # g b^T + b g^T + stiffness b b^T / V for each pair of nodes, as a half and its transpose.
    half = (g + 0.5 * (stiffness / V)[:, None, None] * b) / V[:, None, None]
    one, other = np.triu_indices(b.shape[1])
    outer = half[:, one, :, None] * b[:, other, None, :] + b[:, one, :, None] * half[:, other, None]
    couplings = Couplings(b, g, r.change, r.pressure, stiffness)
    return Condensed(_eliminated(scene, r, couplings), pair_matrices(grid, A) + outer, couplings)


def _first(H: jax.Array, change: jax.Array, stress: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the derivatives in ``H`` (3, 3) and ``change`` () of an energy with ``stress``."""
    return jax.vjp(with_volume_change, H, change)[1](stress)


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
    return at_points(jax.grad(density, (0, 1)), tissue, H, per_point(H, change))


def _residuals(
    scene: Scene, H: jax.Array, volumes: Volumes, P: jax.Array, slope: jax.Array
) -> _Residuals:
    """Return the derivatives of ``L`` from the density's, in ``H`` and in the volumes."""
    V, p = _volume(scene), volumes.pressure
    change, cofactor = _over_points(jax.value_and_grad(volume_change), H)
    return _Residuals(
        nodal_vectors(scene.blocks, P + p[:, None, None, None] * cofactor),
        block_integral(scene, slope) - p * V,
        block_integral(scene, change) - V * volumes.change,
    )


def _eliminated(scene: Scene, r: _Residuals, couplings: Couplings) -> jax.Array:
    """Return ``f_e`` (b, a, 3) of the module docstring."""
    V, stiffness = _volume(scene), couplings.stiffness
    along_g, along_b = r.pressure / V, (r.change + stiffness * r.pressure / V) / V
    return r.force + along_g[:, None, None] * couplings.g + along_b[:, None, None] * couplings.b


def _at_points(function, H: jax.Array, change: jax.Array, *fields: jax.Array):  # noqa: ANN001, ANN202
    """Return ``function`` of each point, with the ``change`` (b,) of its block."""
    return at_points(
        lambda *point: function(*point[:-1]), Tissue(), H, per_point(H, change), *fields
    )


def per_point(H: jax.Array, change: jax.Array) -> jax.Array:
    """Return ``change`` (b,) of the blocks at each of their points, (b, q)."""
    return jnp.broadcast_to(change[:, None], H.shape[:2])


def _over_points(function, H: jax.Array):  # noqa: ANN001, ANN202
    """Return ``function`` of each displacement gradient of ``H`` (b, q, 3, 3)."""
    return jax.vmap(jax.vmap(function))(H)


def volume_change(H: jax.Array) -> jax.Array:
    """Return ``J - 1`` of a displacement gradient (3, 3)."""
    return Strain(H).J_minus_1


def _mean_change(scene: Scene, H: jax.Array) -> jax.Array:
    """Return the mean ``J - 1`` (b,) of each block."""
    return block_integral(scene, _over_points(volume_change, H)) / _volume(scene)


def block_integral(scene: Scene, density: jax.Array) -> jax.Array:
    """Return the integral (b,) over each block of ``density`` (b, q)."""
    return jnp.sum(scene.blocks.weights * density, axis=1)


def _volume(scene: Scene) -> jax.Array:
    """Return the volume (b,) of each block at rest, mm3."""
    return jnp.sum(jnp.asarray(scene.blocks.weights), axis=1)


def block_gradients(scene: Scene, u: jax.Array) -> jax.Array:
    """Return the displacement gradient (b, q, 3, 3) at the blocks' points."""
    return scene.blocks.gather(displacement_gradient(scene, u))
