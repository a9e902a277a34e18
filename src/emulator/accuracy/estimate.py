r"""The error of a prediction, estimated from its residual: no solution needed.

A prediction :math:`u = u^* + e` near the equilibrium :math:`u^*`, where :math:`r(u^*) = 0`, has
the residual of the energy's expansion about :math:`u`,

.. math::
    0 = r(u - e) = r(u) - K(u)\, e + \tfrac12 K'(u)[e, e] - \dots
    \quad\Rightarrow\quad
    K(u)^{-1} r(u) = e - \tfrac12 K^{-1} K'[e, e] + \dots

so :math:`\hat e = K^{-1} r`, Newton's step with the opposite sign, is the error to first order.
The energy gap is :math:`\Pi(u) - \Pi(u^*) = \tfrac12\, r \cdot K^{-1} r` to second order, and
the error of an observed quantity :math:`q` is :math:`dq(u)[\hat e]` to first.

**Effectivity** :math:`|\hat e| / |e|` differs from 1 by
:math:`\tfrac12 |K^{-1} K'[e, e]| / |e|`, which is proportional to the error: it tends to 1
as predictions of any kind improve, and departs from 1 where the error is so large that the body's
stiffness changes along it, as it does outside the box. One more back-substitution with the factors
at hand measures the departure, by the *contraction*

.. math:: \Theta = \frac{|K(u)^{-1} r(u - \hat e)|}{|\hat e|},

about the relative error of :math:`\hat e`. If every further step shrinks by this factor,
:math:`|\hat e - e| \le \Theta |\hat e| / (1 - \Theta)`, so :math:`\Theta \le 1/4`
means an effectivity between 3/4 and 3/2.
That takes a tangent like that at the equilibrium. Where half of all forces are out of balance the
strains, and the stiffness they lend, are mostly error, and one step may be three times too short.
Where :math:`\Theta` is larger, or the step would invert an element, or the tangent is indefinite,
it may be ten times too long. Then FEM's guarded iteration starts from the prediction and runs until
a step is less than a quarter of the way travelled so far; the error is the whole way.
Where the prediction itself inverts elements, the iteration starts from the first sound state on the
line to the solution at the centre of the box, and the way to that state is part of the error.

The tangent at the prediction costs a factorisation. The tangent at the centre of the box is
factorised once; as preconditioner of a few conjugate gradients on :math:`K(u)\, \hat e = r` it is
cheaper and less accurate: good where the body turns little between the centre and :math:`u`, poor
for a bending beam (docs/experiments.md, "An error bar from the forces out of balance").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.accuracy.guard import Guard, guard
from emulator.accuracy.step import (
    Distance,
    gradients_distance,
    guarded_distance,
    newton_distance,
    sound_state,
)
from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled, cond
from emulator.fem.simulator import Simulator
from emulator.scenes.scene import Scene
from emulator.surrogates.protocol import ForwardMap

Tangent = Literal["present", "centre"]


class ErrorEstimate(NamedTuple):
    """The error of one prediction; every field gains leading axes under ``vmap``, all are finite.

    displacement : (n, 3) mm, the prediction; the centre's solution if it is not finite.
    field : (n, 3) mm, the prediction less the equilibrium.
    err_u : (n,) mm, length of ``field`` at each node. median, mean, max : () of ``err_u``.
    energy_gap : () mN mm, the prediction's potential energy less ``least_energy``. If the
        prediction is inverted, its energy is infinite; the nearest sound state's is taken.
    least_energy : () mN mm, potential energy of the equilibrium. Both energies are meaningless
        without a potential.
    contraction : () about the relative error of ``field``; with the tangent of the centre, the
        fraction of the residual that is left, which bounds nothing.
    iterations : () of FEM that replaced the single step; 0 where that was accepted.
    valid : () whether ``field`` is reliable. It may be where the prediction itself is not.
    guard : reasons not to trust the prediction.
    """

    displacement: jax.Array
    field: jax.Array
    err_u: jax.Array
    median: jax.Array
    mean: jax.Array
    max: jax.Array
    energy_gap: jax.Array
    least_energy: jax.Array
    contraction: jax.Array
    iterations: jax.Array
    valid: jax.Array
    guard: Guard

    def of(self, quantity: Callable[[jax.Array], jax.Array]) -> jax.Array:
        """Error of ``quantity(u)`` to first order, in its unit: its derivative along ``field``.

        ``quantity`` is any differentiable function of the displacement (n, 3) in mm.
        """
        return jax.jvp(quantity, (self.displacement,), (self.field,))[1]


@dataclass(frozen=True, eq=False)
class ErrorBar:
    """Error estimates of ``forward``; made by :func:`error_bar`.

    centre : (n, 3) mm, FEM solution at the centre of the box.
    """

    forward: ForwardMap
    simulator: Simulator
    tangent: Tangent
    iterations: int
    centre: jax.Array

    @property
    def scene(self) -> Scene:
        """The scene of the forward map."""
        return self.forward.scene

    def __call__(self, theta: jax.Array) -> ErrorEstimate:
        """Error of the forward map at ``theta`` (p,), inside the box or not."""
        theta = jnp.asarray(theta, dtype=float)
        self._check_shape("theta", theta, (len(self.scene.parameters),))
        traced = isinstance(theta, jax.core.Tracer)
        return self.of_field(self.forward(theta) if traced else self._forward(theta), theta)

    def of_field(self, u: jax.Array, theta: jax.Array) -> ErrorEstimate:
        """Error of any displacement ``u`` (n, 3) mm as a prediction at ``theta`` (p,)."""
        u, theta = jnp.asarray(u, dtype=float), jnp.asarray(theta, dtype=float)
        self._check_shape("theta", theta, (len(self.scene.parameters),))
        self._check_shape("displacement", u, self.scene.held.shape)
        sound, safe_theta = self._prepare(u, theta)
        return self._finish(u, theta, sound, self._distance(sound, safe_theta))

    def _distance(self, sound: jax.Array, theta: jax.Array) -> Distance:
        """Distance of a state that can be linearised; FEM's iteration where one step is no good."""
        if self.tangent == "centre":
            return self._by_gradients(sound, theta)
        step = self._step(sound, theta)
        return cond(
            step.settled,
            lambda: step,
            lambda: self._guarded(sound, theta)._replace(indefinite=step.indefinite),
        )

    def _check_shape(self, name: str, array: jax.Array, expected: tuple[int, ...]) -> None:
        if array.shape != expected:
            raise InputError(
                f"scene '{self.scene.name}': {name} has shape {array.shape}; expected {expected}"
            )

    # ---- compiled parts ------------------------------------------------------------------------
    @cached_property
    def _forward(self):  # noqa: ANN202 - jitted closures, private
        return jax.jit(lambda theta: self.forward(theta))

    @cached_property
    def _prepare(self):  # noqa: ANN202
        return compiled(partial(sound_state, self.scene, self.centre))

    @cached_property
    def _step(self):  # noqa: ANN202
        return compiled(partial(newton_distance, self.simulator.system))

    @cached_property
    def _guarded(self):  # noqa: ANN202
        return compiled(partial(guarded_distance, self.simulator))

    @cached_property
    def _by_gradients(self):  # noqa: ANN202
        system = self.simulator.system
        with jax.ensure_compile_time_eval():
            values = np.asarray(self.simulator.tangent(self.centre, self.scene.centre))
        return compiled(partial(gradients_distance, system, values, self.iterations))

    @cached_property
    def _finish(self):  # noqa: ANN202
        return compiled(partial(_report, self.simulator.system, self.centre))


def error_bar(
    forward: ForwardMap,
    simulator: Simulator,
    tangent: Tangent = "present",
    *,
    iterations: int = 4,
) -> ErrorBar:
    """Error estimates of ``forward``, a map over all nodes. Solves once, at the box's centre.

    Parameters
    ----------
    tangent : ``present`` (at each prediction, factorised each time) or ``centre`` (of the box,
        factorised once: cheaper, less accurate).
    iterations : conjugate gradients with the tangent of the centre, 1 or more.

    Raises
    ------
    InputError
        Bad choices, a map over some nodes only, or ``centre`` for loads without a potential.
    SolverError
        No solution at the centre of the box.
    """
    scene = forward.scene
    if len(forward.nodes) != len(scene.mesh.nodes):
        raise InputError("an error bar needs a forward map over all nodes")
    if scene.fingerprint != simulator.scene.fingerprint:
        raise InputError(
            f"error bar: the map is of scene '{scene.name}' ({scene.fingerprint}), the simulator "
            f"of '{simulator.scene.name}' ({simulator.scene.fingerprint})"
        )
    if tangent not in ("present", "centre"):
        raise InputError(f"error bar: tangent '{tangent}'; use present or centre")
    if iterations < 1:
        raise InputError(f"error bar: {iterations} conjugate gradients; give 1 or more")
    if tangent == "centre" and simulator.system.forces:
        raise InputError(
            f"scene '{scene.name}': a follower pressure has no symmetric tangent; use "
            "tangent='present'"
        )
    return ErrorBar(forward, simulator, tangent, iterations, simulator(scene.centre))


def _report(
    system: System,
    centre: jax.Array,
    u: jax.Array,
    theta: jax.Array,
    sound: jax.Array,
    step: Distance,
) -> ErrorEstimate:
    """The estimate, with finite numbers even where the step failed."""
    against = guard(system.scene, theta, u)
    given = jnp.where(against.finite, u, centre)
    field = given - sound + step.move
    known = against.finite & jnp.all(jnp.isfinite(field)) & jnp.isfinite(step.gap)
    valid = known & step.settled
    # No estimate: take the distance to the centre's solution, or the whole displacement.
    unknown = given - jnp.where(against.finite, centre, 0.0)
    field = jnp.where(known, field, unknown)
    err_u = jnp.sqrt(jnp.sum(field**2, axis=-1))
    gap = jnp.where(known, step.gap, 0.0)
    safe = jnp.where(jnp.isfinite(theta), theta, system.scene.centre)
    energy = system.potential(sound, safe, 1.0, system.follower_force(sound, safe))[0] - gap
    return ErrorEstimate(
        displacement=given,
        field=field,
        err_u=err_u,
        median=jnp.median(err_u),
        mean=jnp.mean(err_u),
        max=jnp.max(err_u),
        energy_gap=gap,
        least_energy=jnp.where(jnp.isfinite(energy), energy, 0.0),
        contraction=jnp.where(jnp.isfinite(step.contraction), step.contraction, 1.0),
        iterations=step.iterations,
        valid=valid,
        guard=against._replace(indefinite=step.indefinite, unsettled=~valid & against.finite),
    )
