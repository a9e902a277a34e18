r"""The error of a prediction, estimated from its residual, and reasons not to trust it.

No solution is needed.

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
stiffness changes along it, as it does outside the box. One more back-substitution with the same
factors measures the departure, by the *contraction*

.. math:: \Theta = \frac{|K(u)^{-1} r(u - \hat e)|}{|\hat e|},

about the relative error of :math:`\hat e`. If every further step shrinks by this factor,
:math:`|\hat e - e| \le \Theta |\hat e| / (1 - \Theta)`, so :math:`\Theta \le 1/4`
means an effectivity between 3/4 and 3/2.
This holds where the tangent resembles the equilibrium's. Where half of all forces are out of
balance, the strains and their stiffness are mostly error, and one step may be three times too
short. Where :math:`\Theta` is larger, or the step would invert an element, or the tangent is
indefinite, one step may be ten times too long. Then FEM's guarded iteration starts from the
prediction and runs until a step is less than a quarter of the way travelled so far; the error is
the whole way. Where the prediction itself inverts elements, the iteration starts from the first
valid state on the line to the solution at the centre of the box, and the way to that state is part
of the error.

The tangent at the prediction costs a factorisation. The tangent at the centre of the box, as
preconditioner of a few conjugate gradients, is cheaper and too inaccurate for a bending beam
(docs/experiments.md, "An error bar from the forces out of balance").

Inside ``jit`` a :class:`Guard` is flags and numbers; outside, :meth:`Guard.sentence` puts them in
words.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled, cond, is_traced, one_by_one, while_loop
from emulator.fem.energy import at_points, require_shape, volume_ratio
from emulator.fem.formulations.displacement import UNBALANCED
from emulator.fem.linear import Outcome
from emulator.fem.load_stepping import LoadStepping
from emulator.fem.simulator import Simulator
from emulator.fem.solution import NewtonState, Status
from emulator.mechanics.kinematics import Barriers, Strain
from emulator.scenes.scene import Scene, with_mesh
from emulator.scenes.tissue import Tissue
from emulator.surrogates.protocol import ForwardMap

LARGEST_U = 1e100  # mm; larger displacements count as not finite: J, their cube, would overflow
# Largest contraction of an accepted step (docs/experiments.md, "An error bar from the forces out of
# balance").
_CONTRACTION = 0.25
_LEAST_SHARE = 0.2  # least share of the smallest J after a step or in a replacement state
_ROUND_OFF = 1e-9  # errors below this fraction of the displacement are round-off: not checked
_GOOD_STEP = 0.1  # the iteration stops only after a step that leaves at most this much residual
_MOST_ITERATIONS = 30
_FRACTIONS = (1.0, 0.9, 0.75, 0.5, 0.25, 0.1, 0.0)  # along the line from the centre's solution


class Guard(NamedTuple):
    """Reasons not to trust a prediction; every field gains leading axes under ``vmap``.

    theta : the parameters (p,) of the prediction.
    outside : whether each entry of theta is outside its range, (p,) bool.
    finite : whether theta and the prediction are finite numbers, ().
    least_J : the smallest volume ratio (); not above 0 if an element is inverted.
    barrier : () whether a training barrier on J, I1 or I4f would act somewhere, so that training
        did not see the exact energy of this state (see :mod:`emulator.mechanics.kinematics`).
    indefinite : whether the tangent at the prediction is known to be indefinite, ().
    unsettled : whether no equilibrium was found near the prediction, ().
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
        valid = self.finite & (self.least_J > 0.0) & ~self.barrier
        return valid & ~jnp.any(self.outside, axis=-1) & ~self.indefinite & ~self.unsettled

    def sentence(self, scene: Scene) -> str:
        """Return all reasons not to trust the prediction, in words; empty when there are none."""
        faults = [
            f"parameter '{p.name}' is {float(value):g} {p.unit}".rstrip()
            + f", outside {p.low:g} to {p.high:g}"
            for p, value, out in zip(scene.parameters, self.theta, self.outside, strict=True)
            if out
        ]
        if not self.finite:
            if not np.isfinite(self.theta).all():
                faults.append("theta is not finite")
            return "; ".join([*faults, "the prediction is not finite"][:2])
        if self.least_J <= 0.0:
            faults.append(f"an element is inverted (least J = {float(self.least_J):.3g})")
        elif self.barrier:
            faults.append("an element is so deformed that the barriers of training act on it")
        if self.indefinite:
            faults.append("the tangent is indefinite there: far from a stable equilibrium")
        if self.unsettled:
            faults.append("no equilibrium was found near it")
        return "; ".join(faults)


def guard(scene: Scene, theta: jax.Array, u: jax.Array) -> Guard:
    """Check theta (p,) and the prediction ``u`` (n, 3) mm alone; nothing is factorised."""
    finite = jnp.all(jnp.abs(u) < LARGEST_U) & jnp.all(jnp.isfinite(theta))
    J, I1, I4f = invariants(scene, jnp.where(finite, u, 0.0), theta)
    limits = Barriers()
    active = jnp.any(limits.J_start > J) | jnp.any(limits.I1_start < I1)
    no = jnp.array(False)
    # Each entry of theta with all others at the centre of the box; NaN is outside.
    alone = jnp.eye(len(scene.parameters), dtype=bool)
    single_changes = jnp.where(alone, theta[None, :], scene.centre)
    return Guard(
        theta=theta,
        outside=~scene.space.contains(single_changes),
        finite=finite,
        least_J=jnp.min(J),
        barrier=active | jnp.any(I4f > limits.I4f_start),
        indefinite=no,
        unsettled=no,
    )


def invariants(
    scene: Scene, u: jax.Array, theta: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return ``J``, ``I1`` and ``I4f`` at every quadrature point, (m, q).

    I1 and I4f are the larger of the invariant and its isochoric part, as laws use either. Isochoric
    parts of inverted points are NaN and left out; without fibres I4f is 0.
    """

    def measures(H: jax.Array, tissue: Tissue) -> tuple[jax.Array, jax.Array, jax.Array]:
        strain = Strain(H, directions=tissue.directions)
        J = 1.0 + strain.J_minus_1
        I1 = 3.0 + jnp.fmax(strain.I1_minus_3, strain.isochoric_I1_minus_3)
        if tissue.directions is None:
            return J, I1, jnp.zeros_like(J)
        fibre = strain.fibre + H @ strain.fibre
        isochoric = 1.0 + strain.isochoric_I4f_minus_1
        return J, I1, jnp.fmax(jnp.vdot(fibre, fibre), isochoric)

    return at_points(measures, scene.gradients(u), scene.tissue_at(theta))


class Distance(NamedTuple):
    """The distance of a field from equilibrium, by one of the two methods.

    error : the field less the equilibrium, (n, 3) mm.
    gap : the field's potential energy less the equilibrium's, () mN mm.
    contraction : the estimated relative error of ``error``, ().
    iterations : the number of FEM iterations, ().
    indefinite : whether the tangent is known to be indefinite, ().
    accepted : whether the method's own check accepts the result, ().
    """

    error: jax.Array
    gap: jax.Array
    contraction: jax.Array
    iterations: jax.Array
    indefinite: jax.Array
    accepted: jax.Array


def _least_J(scene: Scene, u: jax.Array) -> jax.Array:
    return jnp.min(volume_ratio(scene, u))


def _norm(field: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(field**2))


def valid_state(
    scene: Scene, centre: jax.Array, u: jax.Array, theta: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return ``u`` (n, 3) and ``theta`` (p,), changed where the energy has no tangent.

    ``u`` is put on its supports and, if an element is inverted, moved towards ``centre``, the
    solution (n, 3) at the centre of the box, until none is. Entries of theta that are not finite
    are replaced by the centre's.
    """
    finite = jnp.all(jnp.abs(u) < LARGEST_U)
    theta = jnp.where(jnp.isfinite(theta), theta, scene.centre)
    supported = scene.on_supports(jnp.where(finite, u, centre), theta)
    fractions = jnp.array(_FRACTIONS)[:, None, None]
    states = jnp.where(fractions == 1.0, supported, centre + fractions * (supported - centre))
    J = jax.vmap(partial(_least_J, scene))(states)
    # The prediction need only have J > 0; a replacement must keep J well above 0.
    valid = (_LEAST_SHARE * J[-1] < J).at[0].set(J[0] > 0.0)
    return states[jnp.argmax(valid)], theta


def newton_distance(system: System, u: jax.Array, theta: jax.Array) -> Distance:
    """Take Newton's step with the opposite sign, and check it by one more back-substitution."""
    residual, _, relative = system.balance(u, theta)
    tangent = system.tangent(u, theta)
    values = system.pattern.safe_values(tangent)
    step, outcome = system.attempt(values, residual)
    error = system.extend(step)
    corrected = u - error
    upright = _least_J(system.scene, corrected) > _LEAST_SHARE * _least_J(system.scene, u)
    remainder = system.residual(jnp.where(upright, corrected, u), theta)
    length = _norm(error)
    contraction = _norm(system.attempt(values, remainder)[0]) / jnp.where(length > 0, length, 1.0)
    gap = 0.5 * jnp.vdot(residual, system.restrict(error))
    valid = system.pattern.solvable(tangent) & jnp.isfinite(length) & upright & (gap >= 0.0)
    exact = length <= _ROUND_OFF * _norm(u)
    # Strains that hardly balance any load are due to the error, and so is their stiffness.
    contracts = (contraction <= _CONTRACTION) & (relative <= UNBALANCED)
    return Distance(
        error=error,
        gap=gap,
        contraction=jnp.where(exact, jnp.minimum(contraction, 1.0), contraction),
        iterations=jnp.array(0),
        indefinite=(outcome == Outcome.INDEFINITE) | (gap < 0.0),
        accepted=valid & (exact | contracts),
    )


def guarded_distance(simulator: Simulator, u: jax.Array, theta: jax.Array) -> Distance:
    """Iterate by FEM from ``u`` until steps are short beside the distance covered; return it."""
    system = simulator.system
    stepping = LoadStepping(system, simulator.options, theta)

    def advance(carry: tuple[NewtonState, jax.Array, jax.Array]):  # noqa: ANN202
        state, _, _ = carry
        next_state = stepping.step(state)
        way, step = _norm(next_state.u - u), _norm(next_state.u - state.u)
        # A shortened step is small too, but leaves most of its residual.
        short = (step <= _CONTRACTION * way) & (next_state.load >= 1.0)
        short &= next_state.relative_residual <= _GOOD_STEP * state.relative_residual
        finished = short | (next_state.status == Status.CONVERGED)
        return next_state, finished, step / jnp.where(way > 0, way, 1.0)

    def unfinished(carry: tuple[NewtonState, jax.Array, jax.Array]) -> jax.Array:
        state, finished, _ = carry
        running = (state.status == Status.RUNNING) & (state.load >= 1.0)
        return running & ~finished & (state.iterations < _MOST_ITERATIONS)

    start = stepping.begin(u)
    converged = start.status == Status.CONVERGED
    state, finished, ratio = while_loop(unfinished, advance, (start, converged, jnp.array(0.0)))
    follower = system.follower_force(u, theta)
    gap = system.potential(u, theta, 1.0, follower)[0]
    gap = gap - system.potential(state.u, theta, 1.0, follower)[0]
    return Distance(u - state.u, gap, ratio, state.iterations, jnp.array(False), finished)


class ErrorEstimate(NamedTuple):
    """The error of one prediction; every field gains leading axes under ``vmap``, all are finite.

    displacement : the prediction (n, 3) mm; the centre's solution if it is not finite.
    field : the prediction less the equilibrium, (n, 3) mm.
    err_u : (n,) mm, length of ``field`` at each node. median, mean, max : () of ``err_u``.
    energy_gap : () mN mm, the prediction's potential energy less ``least_energy``. If the
        prediction is inverted, its energy is infinite; the first valid state's is taken.
    least_energy : () mN mm, potential energy of the equilibrium. Both energies are meaningless
        without a potential.
    contraction : the estimated relative error of ``field``, ().
    iterations : the FEM iterations () that replaced the single step; 0 where it was accepted.
    valid : whether ``field`` is reliable, (). It may be where the prediction is not.
    guard : the reasons not to trust the prediction.
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
        """Return the error of ``quantity(u)`` to first order: its derivative along ``field``.

        quantity : any differentiable function of the displacement (n, 3) in mm.
        """
        return jax.jvp(quantity, (self.displacement,), (self.field,))[1]


class ErrorBar:
    """Error estimates of ``forward``, a map over all nodes; one solve, at the centre of the box.

    :class:`InputError` for a map over some nodes, or of another scene than the simulator's;
    :class:`SolverError` where there is no solution at the centre.

    centre : the FEM solution at the centre of the box, (n, 3) mm.
    """

    def __init__(self, forward: ForwardMap, simulator: Simulator) -> None:
        self.forward, self.scene = forward, with_mesh(forward.scene)
        if len(forward.nodes) != self.scene.node_count:
            raise InputError("an error bar needs a forward map over all nodes")
        if self.scene.fingerprint != simulator.scene.fingerprint:
            raise InputError(
                f"error bar: the map is of scene '{self.scene.name}' ({self.scene.fingerprint}), "
                f"the simulator of '{simulator.scene.name}' ({simulator.scene.fingerprint})"
            )
        self.centre = simulator(self.scene.centre)
        self._forward = jax.jit(lambda theta: forward(theta))
        self._prepare = compiled(partial(valid_state, self.scene, self.centre))
        self._step = compiled(partial(newton_distance, simulator.system))
        self._by_fem = compiled(partial(guarded_distance, simulator))
        self._finish = compiled(partial(_report, simulator.system, self.centre))

    def __call__(self, theta: jax.Array) -> ErrorEstimate:
        """Estimate the error of the forward map at ``theta`` (p,), inside the box or not."""
        theta = jnp.asarray(theta, dtype=float)
        require_shape(self.scene, "theta", theta, (len(self.scene.parameters),))
        return self.of_field((self.forward if is_traced(theta) else self._forward)(theta), theta)

    def of_field(self, u: jax.Array, theta: jax.Array) -> ErrorEstimate:
        """Estimate the error of any displacement ``u`` (n, 3) mm as a prediction at ``theta``."""
        u, theta = jnp.asarray(u, dtype=float), jnp.asarray(theta, dtype=float)
        require_shape(self.scene, "theta", theta, (len(self.scene.parameters),))
        require_shape(self.scene, "displacement", u, self.scene.held.shape)
        state, safe_theta = self._prepare(u, theta)
        # Under vmap one after the other: side by side, FEM would run for accepted steps, too.
        measure = one_by_one(self._distance) if is_traced(u, theta) else self._distance
        return self._finish(u, theta, state, measure(state, safe_theta))

    def _distance(self, state: jax.Array, theta: jax.Array) -> Distance:
        """Return the distance to equilibrium: by one step of Newton, or by FEM."""
        step = self._step(state, theta)
        return cond(
            step.accepted,
            lambda: step,
            lambda: self._by_fem(state, theta)._replace(indefinite=step.indefinite),
        )


def _report(
    system: System,
    centre: jax.Array,
    u: jax.Array,
    theta: jax.Array,
    state: jax.Array,
    distance: Distance,
) -> ErrorEstimate:
    """Combine the distance of the valid ``state`` with the way to it; all numbers are finite."""
    reasons = guard(system.scene, theta, u)
    prediction = jnp.where(reasons.finite, u, centre)
    field = prediction - state + distance.error
    known = reasons.finite & jnp.all(jnp.isfinite(field)) & jnp.isfinite(distance.gap)
    valid = known & distance.accepted
    # No estimate: take the distance to the centre's solution, or the whole displacement.
    unknown = prediction - jnp.where(reasons.finite, centre, 0.0)
    field = jnp.where(known, field, unknown)
    err_u = jnp.sqrt(jnp.sum(field**2, axis=-1))
    gap = jnp.where(known, distance.gap, 0.0)
    safe = jnp.where(jnp.isfinite(theta), theta, system.scene.centre)
    energy = system.potential(state, safe, 1.0, system.follower_force(state, safe))[0] - gap
    return ErrorEstimate(
        displacement=prediction,
        field=field,
        err_u=err_u,
        median=jnp.median(err_u),
        mean=jnp.mean(err_u),
        max=jnp.max(err_u),
        energy_gap=gap,
        least_energy=jnp.where(jnp.isfinite(energy), energy, 0.0),
        contraction=jnp.where(jnp.isfinite(distance.contraction), distance.contraction, 1.0),
        iterations=distance.iterations,
        valid=valid,
        guard=reasons._replace(indefinite=distance.indefinite, unsettled=~valid & reasons.finite),
    )
