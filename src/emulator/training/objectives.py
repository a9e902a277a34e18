r"""What a training step minimises, for a batch of theta.

.. math::
    \text{energy:} \quad & \tfrac1b \sum \Pi(u, \theta) / \Pi_0 \\
    \text{simulations:} \quad & \tfrac1b \sum \overline{|u - u^*|^2} / s^2 \qquad (\text{Eq. 15}) \\
    \text{both:} \quad & \text{simulations} + \gamma\, \tfrac1b \sum
        \left[\Pi(u, \theta) - \Pi(u^*, \theta)\right] / |\Pi(u^*, \theta)|

with :math:`u^*` the FEM solution, :math:`s` the spread of the displacements and :math:`\Pi_0` a
fixed scale. The energies pass through the barriers, which are inactive near any solution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from emulator.mechanics.barriers import Barriers
from emulator.mechanics.energy import potential_energy
from emulator.scenes.scene import Scene

Objective = Literal["energy", "simulations", "both"]


class Batch(NamedTuple):
    """theta (b, p); FEM displacement (b, n, 3) mm and energy (b,) mN mm, empty without FEM."""

    theta: jax.Array
    displacement: jax.Array
    energy: jax.Array


def make_loss(
    scene: Scene, objective: Objective, spread: float, energy_scale: float, weight: float
) -> Callable[[jax.Array, Batch], jax.Array]:
    """``loss(u, batch)`` for predicted displacements ``u`` (b, n, 3).

    Parameters
    ----------
    spread : typical deviation of the displacements, mm.
    energy_scale : typical size of the energy, mN mm; used by ``energy`` alone.
    weight : gamma above.
    """
    Pi = jax.vmap(potential_energy(scene, Barriers()))

    def energy(u: jax.Array, batch: Batch) -> jax.Array:
        return jnp.mean(Pi(u, batch.theta)) / energy_scale

    def simulations(u: jax.Array, batch: Batch) -> jax.Array:
        return jnp.mean(jnp.sum((u - batch.displacement) ** 2, axis=-1)) / spread**2

    def both(u: jax.Array, batch: Batch) -> jax.Array:
        gap = (Pi(u, batch.theta) - batch.energy) / jnp.abs(batch.energy)
        return simulations(u, batch) + weight * jnp.mean(gap)

    return {"energy": energy, "simulations": simulations, "both": both}[objective]
