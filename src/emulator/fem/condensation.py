r"""Mean dilatation linearised, with each block's volume and pressure as unknowns, eliminated.

A block is a quadratic element, or a patch of linear ones (:mod:`emulator.geometry.patches`).

With displacements alone, a stiff volume term limits Newton's steps to where the constraint is
nearly linear: hundreds of tiny steps at nu = 0.4999 (docs/experiments.md, "Mean dilatation on the
displacements alone"). So each block's volume ratio :math:`\theta` and
pressure :math:`p` become unknowns (Simo, Taylor & Pister 1985), stationary points of

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

With :math:`\hat H(H, \theta)` the gradient that the law sees, its derivatives are those of the law
there, :math:`\hat P` and :math:`\hat A`, and

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
from emulator.scenes.regions import Tissue
from emulator.scenes.scene import Scene


class Volumes(NamedTuple):
    """Iterates of the blocks: volume ratio less 1 and pressure in kPa, both (b,)."""

    change: jax.Array
    pressure: jax.Array


class Condensed(NamedTuple):
    """Linearisation with the volumes eliminated.

    force : (b, a, 3) mN. tangent : (b, pairs, 3, 3) mN/mm.
    b, g : (b, a, 3) couplings; r_change, r_pressure, stiffness : (b,).
    """

    force: jax.Array
    tangent: jax.Array
    b: jax.Array
    g: jax.Array
    r_change: jax.Array
    r_pressure: jax.Array
    stiffness: jax.Array


class _Residuals(NamedTuple):
    """Derivatives of ``L``: in u (b, a, 3), in the volumes (b,), in the pressures (b,)."""

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
    """Forces (b, a, 3) in mN and tangents (b, pairs, 3, 3) in mN/mm of the blocks at ``u`` (n, 3).

    Of points with first Piola stress (b, q, 3, 3) and ``moduli`` (b, q, 3, 3, 3, 3) in kPa, the
    derivatives of the energy in the displacement gradients that the law sees. known : the stress
    whose stiffness the tangents have, where it is not ``stress``.
    """
    if scene.dilatation == "pointwise":
        return nodal_vectors(scene.blocks, stress), pair_matrices(scene.blocks, moduli)
    H, V = _gradient(scene, u), _volume(scene)
    change = _mean_change(scene, H)

    def condensed(stress: jax.Array) -> Condensed:
        slope = _at_points(_first, H, change, stress)[1]
        volumes = Volumes(change, _integral(scene, slope) / V)
        return _condensed(scene, H, volumes, stress, moduli)

    found = condensed(stress)
    return found.force, (found if known is None else condensed(known)).tangent


def consistent(scene: Scene, u: jax.Array, theta: jax.Array) -> Volumes:
    """Volumes and pressures that follow from the displacement ``u`` (n, 3)."""
    H = _gradient(scene, u)
    change = _mean_change(scene, H)
    slope = _slopes(scene, H, change, theta)[1]
    return Volumes(change, _integral(scene, slope) / _volume(scene))


def linearise(scene: Scene, u: jax.Array, volumes: Volumes, theta: jax.Array) -> Condensed:
    """Force and tangent of every block at ``u`` (n, 3) and ``volumes``."""
    H, law = _gradient(scene, u), stress_and_moduli(scene, theta)
    seen = lambda H, change, at: law(with_volume_change(H, change), at)  # noqa: E731
    stress, moduli = at_points(seen, scene.block_tissue_at(theta), H, _wide(H, volumes.change))
    return _condensed(scene, H, volumes, stress, moduli)


def carried(
    scene: Scene, u: jax.Array, volumes: Volumes, theta: jax.Array, at: Condensed
) -> jax.Array:
    """Force (b, a, 3) of every block at ``u`` and ``volumes``, eliminated with ``at``.

    The force of :func:`linearise`, but with the couplings of an earlier iterate: solving with that
    iterate's tangent gives the simplified Newton step.
    """
    H = _gradient(scene, u)
    P, slope = _slopes(scene, H, volumes.change, theta)
    return _eliminated(scene, _residuals(scene, H, volumes, P, slope), at.b, at.g, at.stiffness)


def advance(
    scene: Scene, volumes: Volumes, at: Condensed, move: jax.Array, fraction: jax.Array
) -> Volumes:
    """``volumes`` after ``fraction`` of the step whose displacement is ``move`` (n, 3)."""
    local = move[scene.blocks.connectivity]
    V = _volume(scene)
    change = (at.r_pressure + jnp.einsum("mai,mai->m", at.b, local)) / V
    pressure = at.r_change + jnp.einsum("mai,mai->m", at.g, local) + at.stiffness * change
    return Volumes(volumes.change + fraction * change, volumes.pressure + fraction * pressure / V)


def _condensed(
    scene: Scene, H: jax.Array, volumes: Volumes, stress: jax.Array, moduli: jax.Array
) -> Condensed:
    """The linearisation, from the law's derivatives in the gradients that it sees."""
    grid, V = scene.blocks, _volume(scene)
    P, slope, A, coupling, curvature = _at_points(_second, H, volumes.change, stress, moduli)
    r = _residuals(scene, H, volumes, P, slope)
    p = volumes.pressure[:, None, None, None, None, None]
    A = A + p * _over_points(jax.hessian(_volume_change), H)
    b = nodal_vectors(grid, _over_points(jax.grad(_volume_change), H))
    g, stiffness = nodal_vectors(grid, coupling), _integral(scene, curvature)
    # g b^T + b g^T + stiffness b b^T / V, half of it and its transpose, of each pair of nodes.
    half = (g + 0.5 * (stiffness / V)[:, None, None] * b) / V[:, None, None]
    one, other = np.triu_indices(b.shape[1])
    outer = half[:, one, :, None] * b[:, other, None, :] + b[:, one, :, None] * half[:, other, None]
    return Condensed(
        _eliminated(scene, r, b, g, stiffness),
        pair_matrices(grid, A) + outer,
        b,
        g,
        r.change,
        r.pressure,
        stiffness,
    )


def _first(H: jax.Array, change: jax.Array, stress: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Derivatives in ``H`` (3, 3) and ``change`` (), of an energy with ``stress`` (3, 3) there."""
    return jax.vjp(with_volume_change, H, change)[1](stress)


def _second(
    H: jax.Array, change: jax.Array, P: jax.Array, A: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]:
    """The first two, and in ``H`` twice (3, 3, 3, 3), in both (3, 3), in ``change`` twice ().

    P, A : derivatives (3, 3), (3, 3, 3, 3) in the gradient that the law sees.
    """
    in_H, in_change = jax.jacfwd(with_volume_change, (0, 1))(H, change)
    bent = jax.hessian(lambda *x: jnp.vdot(P, with_volume_change(*x)), (0, 1))(H, change)
    stress = jnp.tensordot(A, in_change, 2)
    return (
        jnp.tensordot(P, in_H, 2),
        jnp.vdot(P, in_change),
        jnp.tensordot(in_H, jnp.tensordot(A, in_H, 2), ((0, 1), (0, 1))) + bent[0][0],
        jnp.tensordot(stress, in_H, 2) + bent[0][1],
        jnp.vdot(in_change, stress) + bent[1][1],
    )


def _slopes(
    scene: Scene, H: jax.Array, change: jax.Array, theta: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Derivatives (b, q, 3, 3) and (b, q) of the density in ``H`` and ``change``, in kPa."""
    energy = point_energy(scene, theta)
    density = lambda H, change, at: energy(with_volume_change(H, change), at)  # noqa: E731
    tissue = scene.block_tissue_at(theta)
    return at_points(jax.grad(density, (0, 1)), tissue, H, _wide(H, change))


def _residuals(
    scene: Scene, H: jax.Array, volumes: Volumes, P: jax.Array, slope: jax.Array
) -> _Residuals:
    """Derivatives of ``L``, from those of the density in ``H`` and in the volumes."""
    V, p = _volume(scene), volumes.pressure
    change, cofactor = _over_points(jax.value_and_grad(_volume_change), H)
    return _Residuals(
        nodal_vectors(scene.blocks, P + p[:, None, None, None] * cofactor),
        _integral(scene, slope) - p * V,
        _integral(scene, change) - V * volumes.change,
    )


def _eliminated(
    scene: Scene, r: _Residuals, b: jax.Array, g: jax.Array, stiffness: jax.Array
) -> jax.Array:
    """``f_e`` (b, a, 3) of the module docstring."""
    V = _volume(scene)
    along_g, along_b = r.pressure / V, (r.change + stiffness * r.pressure / V) / V
    return r.force + along_g[:, None, None] * g + along_b[:, None, None] * b


def _at_points(function, H: jax.Array, change: jax.Array, *fields: jax.Array):  # noqa: ANN001, ANN202
    """``function`` of each point, with the ``change`` (b,) of its block."""
    return at_points(lambda *of: function(*of[:-1]), Tissue(), H, _wide(H, change), *fields)


def _wide(H: jax.Array, change: jax.Array) -> jax.Array:
    return jnp.broadcast_to(change[:, None], H.shape[:2])


def _over_points(function, H: jax.Array):  # noqa: ANN001, ANN202
    """``function`` of each displacement gradient of ``H`` (b, q, 3, 3)."""
    return jax.vmap(jax.vmap(function))(H)


def _volume_change(H: jax.Array) -> jax.Array:
    """``J - 1`` of a displacement gradient (3, 3)."""
    return Strain(H).J_minus_1


def _mean_change(scene: Scene, H: jax.Array) -> jax.Array:
    """Mean ``J - 1`` (b,) of each block."""
    return _integral(scene, _over_points(_volume_change, H)) / _volume(scene)


def _integral(scene: Scene, density: jax.Array) -> jax.Array:
    """Integral (b,) over each block of ``density`` (b, q)."""
    return jnp.sum(scene.blocks.weights * density, axis=1)


def _volume(scene: Scene) -> jax.Array:
    """Volume (b,) of each block at rest, mm3."""
    return jnp.sum(jnp.asarray(scene.blocks.weights), axis=1)


def _gradient(scene: Scene, u: jax.Array) -> jax.Array:
    """Displacement gradient (b, q, 3, 3) at the blocks' points."""
    return scene.blocks.gather(displacement_gradient(scene, u))
