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
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.campaign import Runs
from emulator.fem.energy import displacement_gradient, potential_energy
from emulator.mechanics.kinematics import Barriers
from emulator.scenes.scene import Scene

Objective = Literal["energy", "simulations", "gradients", "both"]
OBJECTIVES: tuple[Objective, ...] = get_args(Objective)

ENERGY_WEIGHT = 0.3  # gamma of the objective "both"
# Standard deviation of the displacements, as a fraction of the centre's, where no FEM run shows it.
_GUESSED_SD = 0.2


class Scales(NamedTuple):
    """Divisors that make each term dimensionless and of order 1.

    displacement : s above, mm. gradient : s_F, dimensionless. energy : Pi_0, mN mm.
    """

    displacement: float
    gradient: float
    energy: float


def make_loss(
    scene: Scene, objective: Objective, scales: Scales
) -> Callable[[jax.Array, Runs], jax.Array]:
    """Return ``loss(u, batch)`` of predictions ``u`` (b, n, 3) mm, by FEM's in a batch."""
    Pi = jax.vmap(potential_energy(scene, Barriers()))

    def energy(u: jax.Array, batch: Runs) -> jax.Array:
        return jnp.mean(Pi(u, batch.theta)) / scales.energy

    def simulations(u: jax.Array, batch: Runs) -> jax.Array:
        misfit = jnp.sum((u - batch.displacement) ** 2, axis=-1)
        return jnp.mean(misfit) / scales.displacement**2

    def gradients(u: jax.Array, batch: Runs) -> jax.Array:
        misfit = mean_square_gradient(scene, u - batch.displacement)
        return simulations(u, batch) + misfit / scales.gradient**2

    def both(u: jax.Array, batch: Runs) -> jax.Array:
        gap = (Pi(u, batch.theta) - batch.energy) / jnp.abs(batch.energy)
        return simulations(u, batch) + ENERGY_WEIGHT * jnp.mean(gap)

    losses = (energy, simulations, gradients, both)
    return dict(zip(OBJECTIVES, losses, strict=True))[objective]


def mean_square_gradient(scene: Scene, difference: jax.Array) -> jax.Array:
    """Return the mean over fields and volume of ``|F(u) - F(v)|^2``, ().

    difference : u - v, (b, n, 3) mm. F is linear in the displacement, so that one gradient of the
        difference is enough.
    """
    weights = scene.discretisation.weights
    H = jax.vmap(lambda d: displacement_gradient(scene, d))(difference)
    squares = jnp.sum(H * H, axis=(-2, -1))
    return jnp.sum(weights * jnp.mean(squares, axis=0)) / jnp.sum(weights)


def loss_scales(scene: Scene, runs: Runs, *, from_runs: bool) -> Scales:
    """Return the scales of the loss: root mean squares of the runs' deviations from the centre's.

    from_runs : whether the deviations come from the runs or are guessed from the centre's solution.
    """
    deviation = _deviations(runs, from_runs)
    return Scales(
        displacement=float(np.sqrt(np.mean(np.sum(deviation**2, axis=-1)))),
        gradient=float(jnp.sqrt(mean_square_gradient(scene, jnp.asarray(deviation)))),
        energy=float(jnp.abs(runs.energy[0])),
    )


def component_scales(scene: Scene, runs: Runs, *, from_runs: bool) -> np.ndarray:
    """Return root mean squares of the deviations at free nodes by component, (3,) mm."""
    deviation, free = _deviations(runs, from_runs), ~scene.held
    component = [float(np.sqrt(np.mean(deviation[:, free[:, k], k] ** 2))) for k in range(3)]
    return np.maximum(component, 1e-3 * max(component))


def _deviations(runs: Runs, from_runs: bool) -> np.ndarray:
    """Return displacements less the centre's, (c, n, 3) mm."""
    centre = np.asarray(runs.displacement[0])
    if from_runs and len(runs.theta) > 1:
        return np.asarray(runs.displacement[1:]) - centre
    return _GUESSED_SD * centre[None]
