r"""Polish: a forward map's prediction moved by Newton steps on the potential energy.

.. math:: u \leftarrow u - K(u)^{-1} r(u, \theta), \qquad
          \frac{\partial u}{\partial \theta} = -K(u)^{-1} \frac{\partial r}{\partial \theta}

Each step about squares the error, at the price of one tangent assembly and factorisation. The
derivative is that of the equilibrium nearby, with the same tangent; differentiating through the
step itself would need third derivatives of the energy and be no more accurate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.functional import volume_ratio
from emulator.fem.simulator import Simulator, displacement_derivative
from emulator.scenes.scene import Scene
from emulator.surrogates.protocol import ForwardMap, Prediction, all_nodes, check_nodes


def newton_step(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    """``u`` (n, 3) mm after one full Newton step, unguarded."""
    tangent = system.pattern.safe_values(system.tangent(u, theta))
    return u - system.extend(system.solve(tangent, system.residual(u, theta)))


@dataclass(frozen=True, eq=False)
class CorrectedForward:
    """``base`` followed by ``steps`` Newton steps, as a forward map."""

    base: ForwardMap
    simulator: Simulator
    steps: int
    nodes: np.ndarray

    kind = "corrected"

    @property
    def scene(self) -> Scene:
        """What is mapped."""
        return self.base.scene

    @cached_property
    def _polish(self):  # noqa: ANN202 - a closure with its derivative, private
        system = self.simulator.system

        @jax.custom_jvp
        def polish(theta: jax.Array) -> jax.Array:
            u = self.base(theta)
            for _ in range(self.steps):
                u = newton_step(system, u, theta)
            return u

        @polish.defjvp
        def derivative(primals, tangents):  # noqa: ANN001, ANN202
            (theta,), (direction,) = primals, tangents
            u = polish(theta)
            return u, displacement_derivative(system, u, theta, direction)

        return polish

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Displacement, valid where the base is and the polished field inverts no element."""
        u = self._polish(theta)
        sound = jnp.all(jnp.isfinite(u)) & (jnp.min(volume_ratio(self.scene, u)) > 0.0)
        u = jnp.where(sound, u, 0.0)
        return Prediction(u[self.nodes], self.base.evaluate(theta).valid & sound)

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (k, 3) in mm."""
        return self.evaluate(theta).displacement

    def at(self, nodes: np.ndarray) -> CorrectedForward:
        """The same map, returning only ``nodes``."""
        return replace(self, nodes=check_nodes(self.scene, nodes))


def corrected(base: ForwardMap, simulator: Simulator, steps: int = 1) -> CorrectedForward:
    """``base``, a map over all nodes, polished by ``steps`` Newton steps."""
    if len(base.nodes) != len(base.scene.mesh.nodes):
        raise InputError("correction needs a forward map over all nodes")
    if steps < 1:
        raise InputError(f"correction: {steps} Newton steps; give 1 or more")
    return CorrectedForward(base, simulator, steps, all_nodes(base.scene))
