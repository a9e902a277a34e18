r"""What a training step minimises, for a batch of theta.

.. math::
    \text{energy:} \quad & \tfrac1b \sum \Pi(u, \theta) / \Pi_0 \\
    \text{simulations:} \quad & \tfrac1b \sum \overline{|u - u^*|^2} / s^2 \qquad (\text{Eq. 15}) \\
    \text{gradients:} \quad & \text{simulations} + \tfrac1b \sum
        \frac1{|\Omega|} \int_\Omega |F(u) - F(u^*)|^2\, dX / s_F^2 \qquad (\text{App. B.1}) \\
    \text{both:} \quad & \text{simulations} + \gamma\, \tfrac1b \sum
        \left[\Pi(u, \theta) - \Pi(u^*, \theta)\right] / |\Pi(u^*, \theta)|

with :math:`u^*` the FEM solution in mm, :math:`F` the dimensionless deformation gradient in the
Frobenius norm, :math:`s` and :math:`s_F` the root mean squares, over the FEM runs, of what both
differ by from the centre's solution, so that each data term is 1 there, and :math:`\Pi_0` a fixed
scale. ``energy``, ``simulations`` and ``gradients`` are the paper's PI, DD and F-DD. The energies
pass through the barriers, which are inactive near any solution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.energy import displacement_gradient, potential_energy
from emulator.mechanics.kinematics import Barriers
from emulator.scenes.scene import Scene
from emulator.training.plan import Objective


class Batch(NamedTuple):
    """theta (b, p); FEM displacement (b, n, 3) mm and energy (b,) mN mm, empty without FEM."""

    theta: jax.Array
    displacement: jax.Array
    energy: jax.Array


class Scales(NamedTuple):
    """Divisors that make each term dimensionless and of order 1.

    displacement : s above, mm. gradient : s_F, dimensionless. energy : Pi_0, mN mm.
    """

    displacement: float
    gradient: float
    energy: float


def make_loss(
    scene: Scene, objective: Objective, scales: Scales, weight: float
) -> Callable[[jax.Array, Batch], jax.Array]:
    """``loss(u, batch)`` for predicted displacements ``u`` (b, n, 3); ``weight`` is gamma above."""
    Pi = jax.vmap(potential_energy(scene, Barriers()))

    def energy(u: jax.Array, batch: Batch) -> jax.Array:
        return jnp.mean(Pi(u, batch.theta)) / scales.energy

    def simulations(u: jax.Array, batch: Batch) -> jax.Array:
        misfit = jnp.sum((u - batch.displacement) ** 2, axis=-1)
        return jnp.mean(misfit) / scales.displacement**2

    def gradients(u: jax.Array, batch: Batch) -> jax.Array:
        misfit = mean_square_gradient(scene, u - batch.displacement)
        return simulations(u, batch) + misfit / scales.gradient**2

    def both(u: jax.Array, batch: Batch) -> jax.Array:
        gap = (Pi(u, batch.theta) - batch.energy) / jnp.abs(batch.energy)
        return simulations(u, batch) + weight * jnp.mean(gap)

    losses = {
        "energy": energy,
        "simulations": simulations,
        "gradients": gradients,
        "both": both,
    }
    return losses[objective]


def mean_square_gradient(scene: Scene, difference: jax.Array) -> jax.Array:
    """Mean over fields and volume of ``|F(u) - F(v)|^2`` for ``difference`` u - v (b, n, 3), ().

    F is linear in the displacement, so one gradient of the difference is enough.
    """
    weights = scene.discretisation.weights
    H = jax.vmap(lambda d: displacement_gradient(scene, d))(difference)
    squares = jnp.sum(H * H, axis=(-2, -1))
    return jnp.sum(weights * jnp.mean(squares, axis=0)) / jnp.sum(weights)
