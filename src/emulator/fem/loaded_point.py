r"""A material point of a body whose loaded shape is known: stress from the way back to rest.

With :math:`h = \partial w/\partial x`, w being the displacement from the loaded shape x to the
stress-free one,

.. math::
    f = I + h, \qquad F = f^{-1}, \qquad H = F - I = -F h, \qquad
    \tau = \frac{\partial W}{\partial F} F^T, \qquad \sigma = \det f\; \tau .

Directions m of the loaded tissue are carried back as material lines, :math:`f_0 = f m / |f m|`.
Sheets are carried back likewise and then turned to be orthogonal to the fibres, in the plane of
both: laws are written for orthogonal ones.

With the law's own stress and moduli at F, and the slopes of its stress in the directions,

.. math::
    d\tau = \left(\frac{\partial P}{\partial F} : dF
        + \frac{\partial P}{\partial f_0} \cdot df_0\right) F^T + P\, dF^T .

Only F and :math:`f_0` are differentiated along all nine components of h, never the law.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from emulator.fem.energy import point_energy, with_volume_change
from emulator.fem.material_point import stress_and_moduli
from emulator.mechanics.kinematics import cofactor, determinant
from emulator.scenes.scene import Scene

Seen = Callable[..., tuple[jax.Array, jax.Array | None]]
"""Of a point and its directions: the displacement gradient that the law sees, and directions."""


def carried_back(h: jax.Array, directions: jax.Array | None) -> jax.Array | None:
    """Directions (3,) or (2, 3) at rest, of those of the loaded tissue; ``h`` (3, 3)."""
    if directions is None:
        return None
    f = h + jnp.eye(3, dtype=h.dtype)
    if directions.ndim == 1:
        return _unit(f @ directions)
    fibre, sheet = _unit(f @ directions[0]), f @ directions[1]
    return jnp.stack([fibre, _unit(sheet - jnp.vdot(sheet, fibre) * fibre)])


def from_rest(h: jax.Array) -> jax.Array:
    """Displacement gradient ``H = F - I`` (3, 3) from rest to the loaded shape; no digits lost."""
    f = h + jnp.eye(3, dtype=h.dtype)
    return -(cofactor(f).T / determinant(f)) @ h


def seen_pointwise(h: jax.Array, directions: jax.Array | None) -> tuple[jax.Array, Any]:
    """What the law sees at a point with a volume ratio of its own."""
    return from_rest(h), carried_back(h, directions)


def seen_with_volume(
    h: jax.Array, change: jax.Array, directions: jax.Array | None
) -> tuple[jax.Array, Any]:
    """What the law sees at a point whose block's volume has changed by ``change``."""
    return with_volume_change(from_rest(h), change), carried_back(h, directions)


def kirchhoff(scene: Scene, theta: jax.Array, seen: Seen) -> Callable[..., jax.Array]:
    r"""``tau(*x, tissue)`` (3, 3) in kPa of a point ``x``, from what the law sees there."""
    energy = point_energy(scene, theta)

    def stress(*x: Any) -> jax.Array:
        *point, at = x
        H, directions = seen(*point, at.directions)
        P = jax.grad(energy)(H, at._replace(directions=directions))
        return P @ (H + jnp.eye(3, dtype=H.dtype)).T

    return stress


def kirchhoff_and_slopes(
    scene: Scene, theta: jax.Array, seen: Seen, count: int
) -> Callable[..., tuple[jax.Array, tuple[jax.Array, ...]]]:
    """:func:`kirchhoff` with its derivatives in each of the ``count`` parts of ``x``."""
    every = tuple(range(count))
    law = stress_and_moduli(scene, theta)
    energy = point_energy(scene, theta)

    def linearised(*x: Any) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        *point, at = x

        def place(*x: jax.Array) -> tuple[jax.Array, jax.Array | None]:
            return seen(*x, at.directions)

        def pulled(directions: jax.Array) -> jax.Array:
            return jax.grad(energy)(H, at._replace(directions=directions)) @ F.T

        H, directions = place(*point)
        ways, turns = jax.jacfwd(place, every)(*point)
        F = H + jnp.eye(3, dtype=H.dtype)
        P, A = law(H, at._replace(directions=directions))
        in_H = jnp.einsum("ijkl,mj->imkl", A, F) + jnp.einsum("il,mk->imkl", P, jnp.eye(3))
        slopes = [jnp.tensordot(in_H, way, 2) for way in ways]
        if directions is not None:
            turned = jax.jacfwd(pulled)(directions)
            turning = [jnp.tensordot(turned, turn, directions.ndim) for turn in turns]
            slopes = [one + other for one, other in zip(slopes, turning, strict=True)]
        return P @ F.T, tuple(slopes)

    return linearised


def _unit(vector: jax.Array) -> jax.Array:
    return vector / jnp.sqrt(jnp.sum(vector**2))
