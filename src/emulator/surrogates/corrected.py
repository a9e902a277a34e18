r"""Correction: Newton steps on the potential energy, from another forward map's prediction.

.. math:: u \leftarrow u - K(u)^{-1} r(u, \theta), \qquad
          \frac{\partial u}{\partial \theta} = -K(u)^{-1} \frac{\partial r}{\partial \theta}

Each step about squares the error and costs one assembly and factorisation of the tangent K. The
derivative is the equilibrium's, by the implicit function theorem with K at the corrected
displacement. Differentiating the step itself would need third derivatives of the energy and be no
more accurate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.energy import volume_ratio
from emulator.fem.simulator import Simulator
from emulator.scenes.scene import Scene, all_nodes, check_nodes, with_mesh
from emulator.surrogates.emulator import EMULATOR
from emulator.surrogates.protocol import (
    ForwardKind,
    ForwardMap,
    Ingredients,
    Option,
    Options,
    Prediction,
    fingerprint_of,
)


def newton_step(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Return ``u`` (n, 3) mm after one full Newton step, without a line search."""
    u = system.scene.on_supports(u, theta)
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
    def label(self) -> str:
        """Label of ``base`` and the number of steps."""
        return f"{self.base.label} + {self.steps} Newton step{'s' if self.steps > 1 else ''}"

    @property
    def scene(self) -> Scene:
        """The scene whose displacement is predicted."""
        return with_mesh(self.base.scene)

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of ``base``, the scene whose equilibrium is sought, steps and nodes."""
        prints = self.base.fingerprint, self.simulator.scene.fingerprint
        return fingerprint_of(self.kind, *prints, str(self.steps), self.nodes)

    @cached_property
    def _corrected(self):  # noqa: ANN202 - a closure with its derivative, private
        system = self.simulator.system

        @jax.custom_jvp
        def correct(theta: jax.Array, start: jax.Array) -> jax.Array:
            u = start
            for _ in range(self.steps):
                u = newton_step(system, u, theta)
            return u

        @correct.defjvp
        def derivative(primals, tangents):  # noqa: ANN001, ANN202
            (theta, _), (direction, _) = primals, tangents
            u = correct(*primals)
            # Zero times the derivative at an impossible displacement would be NaN.
            v = jnp.where(self._possible(u), u, 0.0)
            tangent = system.pattern.safe_values(system.tangent(v, theta))
            _, (force, prescribed) = jax.jvp(system.residual_on_supports(v), (theta,), (direction,))
            return u, prescribed + system.extend(-system.solve(tangent, force))

        return correct

    def _possible(self, u: jax.Array) -> jax.Array:
        """Return whether ``u`` (n, 3) mm is finite and inverts no element."""
        return jnp.all(jnp.isfinite(u)) & (jnp.min(volume_ratio(self.scene, u)) > 0.0)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the displacement (k, 3) mm, valid where ``base`` is and no element is inverted.

        Where ``base`` has no answer, the law may have none either: the value is the centre's.
        """
        start, known = self.base.evaluate(theta)
        theta = jnp.where(known, theta, self.scene.centre)
        u = self._corrected(theta, jax.lax.stop_gradient(start))
        possible = self._possible(u)
        return Prediction(jnp.where(possible, u, 0.0)[self.nodes], known & possible)

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (k, 3) mm."""
        return self.evaluate(theta).displacement

    def at(self, nodes: np.ndarray) -> CorrectedForward:
        """Return the map restricted to ``nodes``; it still computes them all."""
        return replace(self, nodes=check_nodes(self.scene, nodes))


def corrected(base: ForwardMap, simulator: Simulator, steps: int = 1) -> CorrectedForward:
    """Return ``base``, a map over all nodes, corrected by ``steps`` Newton steps."""
    if len(base.nodes) != base.scene.node_count:
        raise InputError("correction needs a forward map over all nodes")
    if steps < 1:
        raise InputError(f"correction: {steps} Newton steps; give 1 or more")
    return CorrectedForward(base, simulator, steps, all_nodes(base.scene))


def _build(ingredients: Ingredients, options: Options) -> ForwardMap:
    return corrected(EMULATOR.build(ingredients, {}), ingredients.fem, options["steps"])


CORRECTED = ForwardKind(
    "corrected",
    "an emulator followed by Newton steps",
    _build,
    (Option("steps", 1, "Newton steps of the corrected map"),),
    words=("emulator",),
)
