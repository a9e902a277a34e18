r"""The error of a prediction, from the forces it leaves out of balance: no solution needed.

A prediction :math:`u = u^* + e` near the equilibrium :math:`u^*`, where :math:`r(u^*) = 0`, has
the residual of the energy's expansion about :math:`u`,

.. math::
    0 = r(u - e) = r(u) - K(u)\, e + \tfrac12 K'(u)[e, e] - \dots
    \quad\Rightarrow\quad
    K(u)^{-1} r(u) = e - \tfrac12 K^{-1} K'[e, e] + \dots

so :math:`\hat e = K^{-1} r` is the error less a term of its square: Newton's step, turned round.
The energy it closes is :math:`\Pi(u) - \Pi(u^*) = \tfrac12\, r \cdot K^{-1} r` to second order, and
the error of an observed quantity :math:`q` is :math:`dq(u)[\hat e]` to first.

**Effectivity** :math:`|\hat e| / |e|` differs from 1 by
:math:`\tfrac12 |K^{-1} K'[e, e]| / |e|`, which is proportional to the error: it tends to 1 as the
prediction gets better, whatever made the prediction, and leaves 1 where the error is so large that
the body's stiffness changes along it, as it does outside the box. How far it leaves is seen by one
back-substitution more with the factors at hand, the *contraction*

.. math:: \Theta = \frac{|K(u)^{-1} r(u - \hat e)|}{|\hat e|},

about the error of :math:`\hat e` relative to itself. For a contraction
:math:`|\hat e - e| \le \Theta |\hat e| / (1 - \Theta)`, so :math:`\Theta \le 1/4`
means an effectivity between 3/4 and 3/2.
Where it is larger, or the step would invert an element or comes of an indefinite tangent, one step
says nothing; it may be ten times too long. Then FEM's own guarded iteration is taken from
the prediction until a step gets less than a quarter of the way so far, and the error is that way.
Where the prediction itself inverts elements, it starts from the first sound state on the line to
the solution at the centre of the box, and what lies between counts as error.

The tangent at the prediction costs a factorisation. That of the centre of the box is factorised
once; with it, a few conjugate gradients on :math:`K(u)\, \hat e = r` are cheaper and less sharp:
good where the body turns little between the centre and :math:`u`, poor for a bending beam.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.error.guard import Guard, guard
from emulator.error.step import (
    Distance,
    gradients_distance,
    guarded_distance,
    newton_distance,
    sound_state,
)
from emulator.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.simulator import Simulator
from emulator.fem.sparse import REFUSALS
from emulator.scenes.scene import Scene
from emulator.surrogates.protocol import ForwardMap

Tangent = Literal["present", "centre"]


class ErrorEstimate(NamedTuple):
    """The error of one prediction; every field gains leading axes under ``vmap``, all are finite.

    displacement : (n, 3) mm, the prediction; the centre's solution where that is not finite.
    field : (n, 3) mm, the prediction less the equilibrium.
    err_u : (n,) mm, its length at each node. median, mean, max : () of it.
    energy_gap : () mN mm, the prediction's potential energy less the least. An inverted
        prediction's is infinite; then that of the sound state nearest to it.
    least_energy : () mN mm, that least energy. Without a potential these two mean nothing.
    contraction : () about how wrong ``field`` is, relative to itself; with the tangent of the
        centre only how much of the residual is left, which bounds nothing.
    iterations : () of FEM that one step had to be replaced by; 0 where it was not.
    valid : () whether ``field`` may be believed. Outside the box it may be, and say that the
        prediction may not.
    guard : what speaks against the prediction.
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
        """Error of ``quantity(u)`` to first order, in its unit: its slope along ``field``.

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
        """What is mapped."""
        return self.forward.scene

    def __call__(self, theta: jax.Array) -> ErrorEstimate:
        """Error of the forward map at ``theta`` (p,), inside the box or not.

        Outside ``jit`` the tangent is factorised by CHOLMOD, which also tells for certain whether
        it is indefinite; inside, by UMFPACK.
        """
        theta = jnp.asarray(theta, dtype=float)
        self._check_shape("theta", theta, (len(self.scene.parameters),))
        traced = isinstance(theta, jax.core.Tracer)
        return self.of_field(self.forward(theta) if traced else self._forward(theta), theta)

    def of_field(self, u: jax.Array, theta: jax.Array) -> ErrorEstimate:
        """Error of any displacement ``u`` (n, 3) mm, said to be the one at ``theta`` (p,)."""
        u, theta = jnp.asarray(u, dtype=float), jnp.asarray(theta, dtype=float)
        self._check_shape("theta", theta, (len(self.scene.parameters),))
        self._check_shape("displacement", u, self.scene.held.shape)
        traced = isinstance(u, jax.core.Tracer) or isinstance(theta, jax.core.Tracer)
        if traced or self.tangent == "centre" or self.simulator.system.forces:
            return self._estimate(u, theta)
        sound, safe_theta = self._prepare(u, theta)
        try:
            step = jax.block_until_ready(self._definite_step(sound, safe_theta))
        except REFUSALS as error:
            if "not positive definite" not in str(error):
                raise
            step = self._guarded(sound, safe_theta)._replace(indefinite=jnp.array(True))
        else:
            if not step.settled:
                step = self._guarded(sound, safe_theta)
        return self._finish(u, theta, sound, step)

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
        return jax.jit(partial(sound_state, self.scene, self.centre))

    @cached_property
    def _definite_step(self):  # noqa: ANN202
        return jax.jit(partial(newton_distance, System(self.scene, "cholmod")))

    @cached_property
    def _guarded(self):  # noqa: ANN202
        return jax.jit(partial(guarded_distance, self.simulator))

    @cached_property
    def _finish(self):  # noqa: ANN202
        return jax.jit(partial(_report, self.simulator.system, self.centre))

    @cached_property
    def _centre_tangent(self) -> tuple[System, np.ndarray]:
        """The system whose factorisation fits the centre's tangent, and that tangent, (nnz,)."""
        system = System(self.scene, "cholmod")
        with jax.ensure_compile_time_eval():
            values = jax.jit(system.tangent)(self.centre, self.scene.centre)
            return system, np.asarray(system.pattern.safe_values(values))

    @cached_property
    def _estimate(self):  # noqa: ANN202
        def estimate(u: jax.Array, theta: jax.Array) -> ErrorEstimate:
            sound, safe_theta = sound_state(self.scene, self.centre, u, theta)
            if self.tangent == "centre":
                step = gradients_distance(*self._centre_tangent, self.iterations, sound, safe_theta)
            else:
                step = newton_distance(self.simulator.system, sound, safe_theta)
                step = jax.lax.cond(
                    step.settled,
                    lambda: step,
                    lambda: guarded_distance(self.simulator, sound, safe_theta)._replace(
                        indefinite=step.indefinite
                    ),
                )
            return _report(self.simulator.system, self.centre, u, theta, sound, step)

        return jax.jit(estimate)


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
    tangent : ``present`` (at each prediction, factorised) or ``centre`` (of the box, factorised
        once: cheaper and less sharp).
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
    """The estimate, finite whatever happened."""
    against = guard(system.scene, theta, u)
    given = jnp.where(against.finite, u, centre)
    field = given - sound + step.move
    known = against.finite & jnp.all(jnp.isfinite(field)) & jnp.isfinite(step.gap)
    valid = known & step.settled
    # Nothing known: as wrong as the box is wide, or as the displacement is large.
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
