r"""Forces and tangents of inverse motion, block by block; see :mod:`emulator.fem.inverse`.

Where points have volume ratios of their own, with :math:`A = \partial\sigma/\partial h`,

.. math::
    f_a = \sum_q \omega_q\, \sigma\, \nabla N_a, \qquad
    K_{ab} = \sum_q \omega_q\, \nabla N_a \cdot A\, \nabla N_b .

With mean dilatation, and with v and V the volumes of a block at x and at X,

.. math::
    r_a = \sum_q \omega_q \left(\det f\, \operatorname{dev} \hat\tau + p I\right) \nabla_x N_a,
    \qquad \theta = \frac{v}{V} = \frac{\sum_q \omega_q}{\sum_q \omega_q \det f},
    \qquad p = \frac{1}{3v} \sum_q \omega_q \det f\, \operatorname{tr} \hat\tau,

:math:`\hat\tau` being the law's Kirchhoff stress at :math:`\hat F = (\theta \det f)^{1/3} F`.
:math:`\theta` and p are iterates, eliminated block by block: with :math:`c = V_w`,
:math:`b = \sum \omega \nabla N`, :math:`d = \sum \omega \det f \operatorname{dev}
\hat\tau_\theta \nabla N`, :math:`e = p_w`, :math:`g = p_\theta`, and the residuals
:math:`r_\theta = \theta V - v`, :math:`r_p = p - p(w, \theta)`,

.. math::
    K_e = K_{ww} - (d + g b) \otimes \theta c / V + b \otimes e, \qquad
    f_e = r_w - (d + g b)\, r_\theta / V - b\, r_p .
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
)
from emulator.fem.loaded_point import (
    kirchhoff,
    kirchhoff_and_slopes,
    seen_pointwise,
    seen_with_volume,
)
from emulator.mechanics.kinematics import Strain, determinant
from emulator.scenes.regions import Tissue
from emulator.scenes.scene import Scene


class Volumes(NamedTuple):
    """Iterates of the blocks: volume ratio less 1 and pressure in kPa, both (b,)."""

    change: jax.Array
    pressure: jax.Array


class Couplings(NamedTuple):
    """What eliminates the volumes and pressures of the blocks.

    change (b,) mm3 and pressure (b,) kPa : their residuals. V : (b,) mm3, volume at rest.
    c, e : (b, a, 3), slopes of V and of p. g : (b,), p by the volume ratio.
    onto_change, onto_pressure : (b, a, 3), the force by either: d + g b, and b.
    """

    change: jax.Array
    pressure: jax.Array
    V: jax.Array
    c: jax.Array
    e: jax.Array
    g: jax.Array
    onto_change: jax.Array
    onto_pressure: jax.Array


class Condensed(NamedTuple):
    """Linearisation of the blocks, volumes eliminated where they share one.

    force : (b, a, 3) mN. tangent : (b, 3a, 3a) mN/mm. couplings : None without shared volumes.
    """

    force: jax.Array
    tangent: jax.Array
    couplings: Couplings | None = None


def block_forces(scene: Scene, w: jax.Array, theta: jax.Array) -> jax.Array:
    """Forces (b, a, 3) in mN of the blocks' stresses at ``w`` (n, 3) mm."""
    h, volumes = _gradient(scene, w), consistent(scene, w, theta)
    if isinstance(volumes, Volumes):
        return _mean_forces(scene, h, volumes, theta)[0]
    law = kirchhoff(scene, theta, seen_pointwise)
    tau = at_points(law, scene.block_tissue_at(theta), h)
    return nodal_vectors(scene.blocks, _det(h)[..., None, None] * tau)


def consistent(scene: Scene, w: jax.Array, theta: jax.Array) -> Volumes | tuple[()]:
    """Volumes and pressures that follow from ``w`` (n, 3); () where points have their own."""
    if scene.dilatation == "pointwise":
        return ()
    h = _gradient(scene, w)
    change = _change(scene, h)
    tau = _stress(scene, h, change, theta)
    return Volumes(change, _pressure(scene, h, tau))


def linearise(
    scene: Scene, w: jax.Array, volumes: Volumes | tuple[()], theta: jax.Array
) -> Condensed:
    """Force and tangent of every block at ``w`` (n, 3) and ``volumes``."""
    h = _gradient(scene, w)
    if isinstance(volumes, Volumes):
        return _condensed(scene, h, volumes, theta)
    law = kirchhoff_and_slopes(scene, theta, seen_pointwise, 1)

    def point(h: jax.Array, at: Tissue) -> tuple[jax.Array, jax.Array]:
        tau, (slope,) = law(h, at)
        det, change = jax.value_and_grad(_det_of)(h)
        return det * tau, det * slope + tau[:, :, None, None] * change

    stress, moduli = at_points(point, scene.block_tissue_at(theta), h)
    return Condensed(nodal_vectors(scene.blocks, stress), _matrices(scene, moduli))


def carried(
    scene: Scene,
    w: jax.Array,
    volumes: Volumes | tuple[()],
    theta: jax.Array,
    at: Couplings | None,
) -> jax.Array:
    """Force (b, a, 3) at ``w`` and ``volumes``, eliminated with the couplings of an iterate."""
    if not isinstance(volumes, Volumes) or at is None:
        return block_forces(scene, w, theta)
    force, change, pressure = _mean_forces(scene, _gradient(scene, w), volumes, theta)
    return _eliminated(force, at._replace(change=change, pressure=pressure))


def advance(
    scene: Scene,
    volumes: Volumes | tuple[()],
    at: Couplings | None,
    move: jax.Array,
    fraction: jax.Array,
) -> Volumes | tuple[()]:
    """``volumes`` after ``fraction`` of the step whose displacement is ``move`` (n, 3)."""
    if not isinstance(volumes, Volumes) or at is None:
        return ()
    local = move[scene.blocks.connectivity]
    along = lambda slope: jnp.einsum("bai,bai->b", slope, local)  # noqa: E731
    change = -(at.change + (1.0 + volumes.change) * along(at.c)) / at.V
    pressure = -at.pressure + along(at.e) + at.g * change
    return Volumes(volumes.change + fraction * change, volumes.pressure + fraction * pressure)


def _condensed(scene: Scene, h: jax.Array, volumes: Volumes, theta: jax.Array) -> Condensed:
    """The linearisation with mean dilatation."""
    grid, v = scene.blocks, _integral(scene, jnp.ones(h.shape[:2]))
    law = kirchhoff_and_slopes(scene, theta, seen_with_volume, 2)

    def point(h: jax.Array, change: jax.Array, at: Tissue) -> tuple[jax.Array, ...]:
        tau, (in_h, in_change) = law(h, change, at)
        det, slope = jax.value_and_grad(_det_of)(h)
        in_h = det * in_h + tau[:, :, None, None] * slope
        return det * tau, in_h, det * in_change, slope

    tau, in_h, in_change, cof = at_points(
        point, scene.block_tissue_at(theta), h, _wide(h, volumes.change)
    )
    trace_h = jnp.einsum("bqiikl->bqkl", in_h)
    K = _matrices(scene, in_h - jnp.einsum("ij,bqkl->bqijkl", jnp.eye(3) / 3.0, trace_h))
    c, b = nodal_vectors(grid, cof), nodal_vectors(grid, jnp.broadcast_to(jnp.eye(3), h.shape))
    e = nodal_vectors(grid, trace_h) / (3.0 * v)[:, None, None]
    g = _integral(scene, _trace(in_change)) / (3.0 * v)
    coupling = nodal_vectors(grid, _deviator(in_change)) + g[:, None, None] * b
    V, ratio = _integral(scene, _det(h)), 1.0 + volumes.change
    pressure = volumes.pressure - _integral(scene, _trace(tau)) / (3.0 * v)
    S = _deviator(tau) + volumes.pressure[:, None, None, None] * jnp.eye(3)
    K = K - _outer(coupling, (ratio / V)[:, None, None] * c) + _outer(b, e)
    at = Couplings(ratio * V - v, pressure, V, c, e, g, coupling, b)
    return Condensed(_eliminated(nodal_vectors(grid, S), at), K, at)


def _mean_forces(
    scene: Scene, h: jax.Array, volumes: Volumes, theta: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Force (b, a, 3) before elimination, and the residuals (b,) of volumes and pressures."""
    tau = _stress(scene, h, volumes.change, theta)
    v, V = _integral(scene, jnp.ones(h.shape[:2])), _integral(scene, _det(h))
    S = _det(h)[..., None, None] * _deviator(tau)
    S = S + volumes.pressure[:, None, None, None] * jnp.eye(3)
    r_pressure = volumes.pressure - _pressure(scene, h, tau)
    return nodal_vectors(scene.blocks, S), (1.0 + volumes.change) * V - v, r_pressure


def _eliminated(force: jax.Array, at: Couplings) -> jax.Array:
    """``f_e`` (b, a, 3) of the module docstring."""
    force = force - (at.change / at.V)[:, None, None] * at.onto_change
    return force - at.pressure[:, None, None] * at.onto_pressure


def _stress(scene: Scene, h: jax.Array, change: jax.Array, theta: jax.Array) -> jax.Array:
    """The law's Kirchhoff stress (b, q, 3, 3) in kPa where blocks share their volume change."""
    law = kirchhoff(scene, theta, seen_with_volume)
    return at_points(law, scene.block_tissue_at(theta), h, _wide(h, change))


def _pressure(scene: Scene, h: jax.Array, tau: jax.Array) -> jax.Array:
    """``p(w, theta)`` (b,) in kPa."""
    v = _integral(scene, jnp.ones(h.shape[:2]))
    return _integral(scene, _det(h) * _trace(tau)) / (3.0 * v)


def _change(scene: Scene, h: jax.Array) -> jax.Array:
    """Volume change (b,) of the blocks, ``v/V - 1``, without loss of digits."""
    det_less_1 = jax.vmap(jax.vmap(_volume_change))(h)
    V = _integral(scene, 1.0 + det_less_1)
    return -_integral(scene, det_less_1) / V


def _volume_change(h: jax.Array) -> jax.Array:
    return Strain(h).J_minus_1


def _matrices(scene: Scene, moduli: jax.Array) -> jax.Array:
    """Matrices (b, 3a, 3a) from derivatives (b, q, 3, 3, 3, 3) of stress in h."""
    count = scene.blocks.connectivity.shape[1]
    one, other = np.indices((count, count))
    found = pair_matrices(scene.blocks, moduli, (one.ravel(), other.ravel()))
    wide = found.reshape(-1, count, count, 3, 3).transpose(0, 1, 3, 2, 4)
    return wide.reshape(-1, 3 * count, 3 * count)


def _outer(one: jax.Array, other: jax.Array) -> jax.Array:
    """Products (b, 3a, 3a) of vectors (b, a, 3)."""
    flat = one.reshape(len(one), -1), other.reshape(len(other), -1)
    return flat[0][:, :, None] * flat[1][:, None, :]


def _gradient(scene: Scene, w: jax.Array) -> jax.Array:
    """``h`` (b, q, 3, 3) at the blocks' points."""
    return scene.blocks.gather(displacement_gradient(scene, w))


def _det_of(h: jax.Array) -> jax.Array:
    return determinant(h + jnp.eye(3, dtype=h.dtype))


def _det(h: jax.Array) -> jax.Array:
    """``det f`` (b, q)."""
    return jax.vmap(jax.vmap(_det_of))(h)


def _integral(scene: Scene, density: jax.Array) -> jax.Array:
    """Integral (b,) over each block, as loaded, of ``density`` (b, q)."""
    return jnp.sum(scene.blocks.weights * density, axis=1)


def _trace(stress: jax.Array) -> jax.Array:
    return jnp.trace(stress, axis1=-2, axis2=-1)


def _deviator(stress: jax.Array) -> jax.Array:
    return stress - _trace(stress)[..., None, None] * jnp.eye(3) / 3.0


def _wide(h: jax.Array, change: jax.Array) -> jax.Array:
    return jnp.broadcast_to(change[:, None], h.shape[:2])
