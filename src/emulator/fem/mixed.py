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

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.functional import at_volume, mean_volume_change
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


def _arguments(scene: Scene, u: jax.Array) -> tuple:
    """Displacements, gradients, weights and tissue of every block, for ``vmap``."""
    grid = scene.blocks
    local = (u[grid.connectivity], jnp.asarray(grid.gradients), jnp.asarray(grid.weights))
    return (*local, scene.block_tissue)


def consistent(scene: Scene, u: jax.Array, theta: jax.Array) -> Volumes:
    """Volumes and pressures that follow from the displacement ``u`` (n, 3)."""

    def one(*block: Any) -> Volumes:
        change = mean_volume_change(*block[:3])
        slope = jax.grad(at_volume(scene, theta), argnums=0)(change, *block)
        return Volumes(change, slope / jnp.sum(block[2]))

    return jax.vmap(one)(*_arguments(scene, u))


def linearise(scene: Scene, u: jax.Array, volumes: Volumes, theta: jax.Array) -> Condensed:
    """Force and tangent of every block at ``u`` (n, 3) and ``volumes``."""
    energy = at_volume(scene, theta)

    def one(change, pressure, local, gradients, weights, own):  # noqa: ANN001, ANN202
        V = jnp.sum(weights)

        def E(v: jax.Array, t: jax.Array) -> jax.Array:
            return energy(t, v, gradients, weights, own)

        def volume(v: jax.Array) -> jax.Array:
            return V * mean_volume_change(v, gradients, weights)

        # One pass of second derivatives gives E_u, E_t and their derivatives.
        (E_u, E_t), ((E_uu, g), (_, E_tt)) = (
            jax.grad(E, (0, 1))(local, change),
            jax.jacfwd(jax.grad(E, (0, 1)), (0, 1))(local, change),
        )
        b, b_u = jax.grad(volume)(local), jax.hessian(volume)(local)
        r_change, r_pressure = E_t - pressure * V, volume(local) - V * change
        outer = jnp.einsum("ai,bj->aibj", g, b)
        tangent = (
            E_uu
            + pressure * b_u
            + (outer + outer.transpose(2, 3, 0, 1)) / V
            + E_tt / V**2 * jnp.einsum("ai,bj->aibj", b, b)
        )
        force = E_u + pressure * b
        force = force + g * r_pressure / V + b * (r_change + E_tt * r_pressure / V) / V
        size = local.size
        return Condensed(force, tangent.reshape(size, size), b, g, r_change, r_pressure, E_tt)

    return jax.vmap(one)(*volumes, *_arguments(scene, u))


def carried(
    scene: Scene, u: jax.Array, volumes: Volumes, theta: jax.Array, at: Condensed
) -> jax.Array:
    """Force (b, a, 3) of every block at ``u`` and ``volumes``, eliminated with ``at``.

    The force of :func:`linearise`, but with the couplings of an earlier iterate: solving with that
    iterate's tangent gives the simplified Newton step.
    """
    energy = at_volume(scene, theta)

    def one(change, pressure, at, local, gradients, weights, own):  # noqa: ANN001, ANN202
        V = jnp.sum(weights)
        E_t, E_u = jax.grad(energy, (0, 1))(change, local, gradients, weights, own)
        mean, slope = jax.value_and_grad(mean_volume_change)(local, gradients, weights)
        r_change, r_pressure = E_t - pressure * V, V * (mean - change)
        force = E_u + pressure * V * slope + at.g * r_pressure / V
        return force + at.b * (r_change + at.stiffness * r_pressure / V) / V

    return jax.vmap(one)(*volumes, at, *_arguments(scene, u))


def advance(
    scene: Scene, volumes: Volumes, at: Condensed, move: jax.Array, fraction: jax.Array
) -> Volumes:
    """``volumes`` after ``fraction`` of the step whose displacement is ``move`` (n, 3)."""
    local = move[scene.blocks.connectivity]
    V = jnp.sum(jnp.asarray(scene.blocks.weights), axis=1)
    change = (at.r_pressure + jnp.einsum("mai,mai->m", at.b, local)) / V
    pressure = at.r_change + jnp.einsum("mai,mai->m", at.g, local) + at.stiffness * change
    return Volumes(volumes.change + fraction * change, volumes.pressure + fraction * pressure / V)
