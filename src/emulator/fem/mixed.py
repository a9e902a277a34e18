r"""Newton steps for mean dilatation, with each block's volume and pressure as iterates.

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
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.functional import (
    at_points,
    displacement_gradient,
    nodal_matrices,
    nodal_vectors,
    point_energy,
    with_volume_change,
)
from emulator.mechanics.kinematics import Strain
from emulator.scenes.scene import Scene


class Volumes(NamedTuple):
    """Iterates of the blocks: volume ratio less 1 and pressure in kPa, both (b,)."""

    change: jax.Array
    pressure: jax.Array


class Condensed(NamedTuple):
    """Linearisation with the volumes eliminated.

    force : (b, a, 3) mN. tangent : (b, 3a, 3a) mN/mm.
    b, g : (b, a, 3) couplings; r_change, r_pressure, stiffness : (b,).
    """

    force: jax.Array
    tangent: jax.Array
    b: jax.Array
    g: jax.Array
    r_change: jax.Array
    r_pressure: jax.Array
    stiffness: jax.Array


def _density(scene: Scene, theta: jax.Array) -> Callable:
    """``(H, change, tissue) -> W`` in kPa: at ``H`` (3, 3) scaled to ``J - 1 = change``."""
    energy = point_energy(scene, theta)
    return lambda H, change, at: energy(with_volume_change(H, change), at)


def _at_points(scene: Scene, function: Callable, H: jax.Array, change: jax.Array) -> Any:
    """``function(H, change, tissue)`` at the blocks' points, with the ``change`` (b,) of each."""
    wide = jnp.broadcast_to(change[:, None], H.shape[:2])
    return at_points(scene, function, H, wide, tissue=scene.block_tissue)


def _over_points(function: Callable, H: jax.Array) -> Any:
    """``function`` of each displacement gradient of ``H`` (b, q, 3, 3)."""
    return jax.vmap(jax.vmap(function))(H)


def _volume_change(H: jax.Array) -> jax.Array:
    """``J - 1`` of a displacement gradient (3, 3)."""
    return Strain(H).J_minus_1


def _integral(scene: Scene, density: jax.Array) -> jax.Array:
    """Integral (b,) over each block of ``density`` (b, q)."""
    return jnp.sum(scene.blocks.weights * density, axis=1)


def _volume(scene: Scene) -> jax.Array:
    """Volume (b,) of each block at rest, mm3."""
    return jnp.sum(jnp.asarray(scene.blocks.weights), axis=1)


def _gradient(scene: Scene, u: jax.Array) -> jax.Array:
    """Displacement gradient (b, q, 3, 3) at the blocks' points."""
    return scene.blocks.gather(displacement_gradient(scene, u))


def consistent(scene: Scene, u: jax.Array, theta: jax.Array) -> Volumes:
    """Volumes and pressures that follow from the displacement ``u`` (n, 3)."""
    H, V = _gradient(scene, u), _volume(scene)
    change = _integral(scene, _over_points(_volume_change, H)) / V
    slope = _at_points(scene, jax.grad(_density(scene, theta), 1), H, change)
    return Volumes(change, _integral(scene, slope) / V)


class _Residuals(NamedTuple):
    """Derivatives of ``L``: in u (b, a, 3), in the volumes (b,), in the pressures (b,)."""

    force: jax.Array
    change: jax.Array
    pressure: jax.Array


def _residuals(scene: Scene, H: jax.Array, volumes: Volumes, theta: jax.Array) -> _Residuals:
    V, p = _volume(scene), volumes.pressure
    P, slope = _at_points(scene, jax.grad(_density(scene, theta), (0, 1)), H, volumes.change)
    change, cofactor = _over_points(jax.value_and_grad(_volume_change), H)
    return _Residuals(
        nodal_vectors(scene.blocks, P + p[:, None, None, None] * cofactor),
        _integral(scene, slope) - p * V,
        _integral(scene, change) - V * volumes.change,
    )


def _eliminated(
    r: _Residuals, b: jax.Array, g: jax.Array, stiffness: jax.Array, V: jax.Array
) -> jax.Array:
    """``f_e`` (b, a, 3) of the module docstring."""
    along_g, along_b = r.pressure / V, (r.change + stiffness * r.pressure / V) / V
    return r.force + along_g[:, None, None] * g + along_b[:, None, None] * b


def linearise(scene: Scene, u: jax.Array, volumes: Volumes, theta: jax.Array) -> Condensed:
    """Force and tangent of every block at ``u`` (n, 3) and ``volumes``."""
    grid, H, V = scene.blocks, _gradient(scene, u), _volume(scene)
    slopes = jax.grad(_density(scene, theta), (0, 1))
    (A, coupling), (_, curvature) = _at_points(scene, jax.jacfwd(slopes, (0, 1)), H, volumes.change)
    p = volumes.pressure[:, None, None, None, None, None]
    A = A + p * _over_points(jax.hessian(_volume_change), H)
    b = nodal_vectors(grid, _over_points(jax.grad(_volume_change), H))
    g, stiffness = nodal_vectors(grid, coupling), _integral(scene, curvature)
    # g b^T + b g^T + stiffness b b^T / V, half of it and its transpose.
    half = (g + 0.5 * (stiffness / V)[:, None, None] * b) / V[:, None, None]
    pair = jnp.einsum("mai,mbj->maibj", half, b)
    tangent = nodal_matrices(grid, A) + pair + pair.transpose(0, 3, 4, 1, 2)
    size = 3 * grid.connectivity.shape[1]
    r = _residuals(scene, H, volumes, theta)
    force = _eliminated(r, b, g, stiffness, V)
    tangent = tangent.reshape(-1, size, size)
    return Condensed(force, tangent, b, g, r.change, r.pressure, stiffness)


def carried(
    scene: Scene, u: jax.Array, volumes: Volumes, theta: jax.Array, at: Condensed
) -> jax.Array:
    """Force (b, a, 3) of every block at ``u`` and ``volumes``, eliminated with ``at``.

    The force of :func:`linearise`, but with the couplings of an earlier iterate: solving with that
    iterate's tangent gives the simplified Newton step.
    """
    r = _residuals(scene, _gradient(scene, u), volumes, theta)
    return _eliminated(r, at.b, at.g, at.stiffness, _volume(scene))


def advance(
    scene: Scene, volumes: Volumes, at: Condensed, move: jax.Array, fraction: jax.Array
) -> Volumes:
    """``volumes`` after ``fraction`` of the step whose displacement is ``move`` (n, 3)."""
    local = move[scene.blocks.connectivity]
    V = _volume(scene)
    change = (at.r_pressure + jnp.einsum("mai,mai->m", at.b, local)) / V
    pressure = at.r_change + jnp.einsum("mai,mai->m", at.g, local) + at.stiffness * change
    return Volumes(volumes.change + fraction * change, volumes.pressure + fraction * pressure / V)
