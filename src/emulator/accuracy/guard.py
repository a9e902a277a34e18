"""Reasons not to trust a prediction, found without solving.

Inside ``jit`` a :class:`Guard` is flags and numbers; outside, :meth:`Guard.sentence` puts them in
words.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.accuracy.step import ENDLESS
from emulator.fem.energy import at_points, displacement_gradient
from emulator.mechanics.kinematics import Barriers, Strain
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue


class Guard(NamedTuple):
    """Reasons not to trust a prediction; every field gains leading axes under ``vmap``.

    theta : (p,) where the prediction was made.
    outside : (p,) bool, entries of theta outside the scene's box.
    finite : whether theta and the prediction are finite numbers.
    least_J : () smallest volume ratio; not above 0 if an element is inverted.
    barrier : () whether a training barrier on J, I1 or I4f would act somewhere, so that training
        did not see the exact energy of this state (see :mod:`emulator.mechanics.kinematics`).
    indefinite : () whether the tangent at the prediction is known to be indefinite.
    unsettled : () whether no equilibrium was found near the prediction.
    """

    theta: jax.Array
    outside: jax.Array
    finite: jax.Array
    least_J: jax.Array
    barrier: jax.Array
    indefinite: jax.Array
    unsettled: jax.Array

    @property
    def trusted(self) -> jax.Array:
        """Whether there is no reason to distrust the prediction, () bool."""
        sound = self.finite & (self.least_J > 0.0) & ~self.barrier
        return sound & ~jnp.any(self.outside, axis=-1) & ~self.indefinite & ~self.unsettled

    def sentence(self, scene: Scene) -> str:
        """All reasons not to trust the prediction, in words; empty when there are none."""
        if not self.finite:
            faults = [] if np.isfinite(self.theta).all() else ["theta is not finite"]
            return "; ".join([*self._beyond(scene), *faults, "the prediction is not finite"][:2])
        faults = self._beyond(scene)
        if self.least_J <= 0.0:
            faults.append(f"an element is inverted (least J = {float(self.least_J):.3g})")
        elif self.barrier:
            faults.append("an element is so deformed that the barriers of training act on it")
        if self.indefinite:
            faults.append("the tangent is indefinite there: far from a stable equilibrium")
        if self.unsettled:
            faults.append("no equilibrium was found near it")
        return "; ".join(faults)

    def _beyond(self, scene: Scene) -> list[str]:
        """Each parameter outside its range, with its value and the range."""
        return [
            f"parameter '{p.name}' is {float(value):g} {p.unit}".rstrip()
            + f", outside {p.low:g} to {p.high:g}"
            for p, value, out in zip(scene.parameters, self.theta, self.outside, strict=True)
            if out
        ]


def guard(scene: Scene, theta: jax.Array, u: jax.Array) -> Guard:
    """Guard from theta (p,) and the prediction ``u`` (n, 3) mm alone; nothing is factorised."""
    finite = jnp.all(jnp.abs(u) < ENDLESS) & jnp.all(jnp.isfinite(theta))
    J, I1, I4f = invariants(scene, jnp.where(finite, u, 0.0), theta)
    limits = Barriers()
    active = jnp.any(limits.J_start > J) | jnp.any(limits.I1_start < I1)
    no = jnp.array(False)
    return Guard(
        theta=theta,
        outside=outside_box(scene, theta),
        finite=finite,
        least_J=jnp.min(J),
        barrier=active | jnp.any(I4f > limits.I4f_start),
        indefinite=no,
        unsettled=no,
    )


def outside_box(scene: Scene, theta: jax.Array) -> jax.Array:
    """Which entries of ``theta`` (p,) lie outside their range, (p,) bool; NaN does.

    Each entry is tested with all others at the centre of the box.
    """
    each = jnp.where(jnp.eye(len(scene.parameters), dtype=bool), theta[None, :], scene.centre)
    return ~scene.space.contains(each)


def invariants(
    scene: Scene, u: jax.Array, theta: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """``J``, ``I1`` and ``I4f`` at every point, (m, q); the last two or their isochoric parts.

    The larger of each pair is returned, as laws use either. Isochoric parts of inverted points are
    NaN and left out; without fibres I4f is 0.
    """

    def measures(H: jax.Array, own: Tissue) -> tuple[jax.Array, jax.Array, jax.Array]:
        strain = Strain(H, directions=own.directions)
        J = 1.0 + strain.J_minus_1
        I1 = 3.0 + jnp.fmax(strain.I1_minus_3, strain.isochoric_I1_minus_3)
        if own.directions is None:
            return J, I1, jnp.zeros_like(J)
        stretched = strain.fibre + H @ strain.fibre
        isochoric = 1.0 + strain.isochoric_I4f_minus_1
        return J, I1, jnp.fmax(jnp.vdot(stretched, stretched), isochoric)

    J, I1, I4f = at_points(measures, scene.tissue_at(theta), displacement_gradient(scene, u))
    return J, I1, I4f
