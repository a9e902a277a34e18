r"""Newton's method far from equilibrium, with the stresses of the integration points as unknowns.

An exponential law makes Newton's method in the displacement overshoot: the strain that a soft
tangent predicts comes back as an enormous stress, and undoing it takes an iteration for each factor
of e. As a function of stress, the strain of such a law is a logarithm. So the strain measures
:math:`\xi` of each integration point (:mod:`emulator.mechanics.measures`) become unknowns of their
own, :math:`\hat\xi`, with the stress :math:`s = \varphi'(\hat\xi)` and stiffness
:math:`C = \varphi''(\hat\xi)` that belong to them, and an iteration solves the linearised

.. math::
    \int \left[s + C\,(\xi(u) - \hat\xi)\right] \cdot \xi'(u) = f, \qquad
    K = \int \xi'^T C\, \xi' + s \cdot \xi''

for the step :math:`\Delta u`. The step predicts the stress :math:`s + C d` with
:math:`d = \xi + \xi' \Delta u - \hat\xi`. Each measure then advances by the fraction
:math:`\beta \in [0, 1]` of its part of d at which the law has that stress (by all of it where the
law is softer there than predicted). Where :math:`\hat\xi = \xi(u)` this is Newton's method, with
its limit and its order.

This is the mixed integration point (MIP) Newton method of Magisano, Leonetti & Garcea (2017), made
for geometric nonlinearity, with measures in place of stress components. Any law that reads nothing
but measures has its inverse, one scalar equation each. With mean dilatation the measures are those
of the gradients that the law sees, so that a block's volume is one of them.

A ventricle from rest takes four to six full steps to a residual of a few percent, all with positive
definite tangents.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.compiled import Number, compiled, cond, while_loop
from emulator.fem.condensation import block_derivatives
from emulator.fem.energy import at_points, law_gradients
from emulator.fem.formulations.displacement import Linearised
from emulator.fem.linear import Outcome
from emulator.fem.linear.reuse import OF_A_START
from emulator.fem.material_point import MaterialPoint
from emulator.fem.newton import largest_admissible
from emulator.mechanics.measures import measures_read
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue

_SHORTEST = 2.0**-4  # fraction of a step below which the schedule of loads has failed


class StressState(NamedTuple):
    """The state that the next iteration needs.

    u : the displacement, (n, 3) mm.
    measures : the strain measures (m, q, k) that the stresses belong to.
    error : the relative residual of ``u``; infinite before the first step, and where the prescribed
        displacements are not met.
    fraction : the fraction of the last step that was taken; below 1 where elements would have been
        inverted, 0 where there was no step.
    definite : whether the tangent of the last step was positive definite.
    refused : the number of steps in a row solved again because their tangent was indefinite.
    """

    u: jax.Array
    measures: jax.Array
    error: jax.Array
    fraction: jax.Array
    definite: jax.Array
    refused: jax.Array


class _FullStep(NamedTuple):
    """A full step (n, 3) mm, whether its tangent was definite, and how many were tried."""

    step: jax.Array
    definite: jax.Array
    tries: jax.Array


@dataclass(frozen=True, eq=False)
class StressIterates:
    """The iteration for one theta at one load factor.

    system : the equations, of a scene that :func:`applies`.
    shrink : the least fraction of the present smallest ``J`` that a step may leave.
    theta : the parameters, (p,).
    load : the load factor.
    """

    system: System
    shrink: float
    theta: jax.Array
    load: jax.Array

    def begin(self, u: jax.Array) -> StressState:
        """Return the state at ``u`` (n, 3) mm, with the stresses of this displacement."""
        unknown, measures = jnp.full((), jnp.inf, float), _measures_of(self.system, u, self.theta)
        return StressState(u, measures, unknown, jnp.ones(()), jnp.array(True), jnp.array(0))

    def step(
        self,
        state: StressState,
        load_stiffness: jax.Array,
        geometric: Number = 1.0,
        again: jax.Array | bool = False,
    ) -> StressState:
        """Return the state after one iteration.

        state : the state before the iteration.
        load_stiffness : the factor of the loads' stiffness in the tangent.
        geometric : the fraction of the stresses' change since rest that has a geometric stiffness.
            With neither stiffness the tangent is definite for most laws, however rough the field.
        again : whether to solve again with neither stiffness where the tangent is not definite.
        """
        system, theta, load = self.system, self.theta, self.load
        first = _FullStep(state.u, jnp.array(False), jnp.array(0))

        def attempt(before: _FullStep) -> _FullStep:
            known = jnp.where(before.tries == 0, 1.0, 0.0)
            factors = known * load_stiffness, known * geometric
            equations = _equations(system, state.u, state.measures, theta, load, *factors)
            force = equations.residual + equations.offset_force
            accuracy = jnp.where(again, 0.0, OF_A_START)  # no factor helps on the way from rest
            solution, outcome = system.attempt(equations.tangent, -force, accuracy)
            definite = outcome == Outcome.OK
            if system.forces:  # the tangent is not symmetric, so check that the step descends
                definite &= jnp.vdot(force, solution) <= 0.0
            step = system.extend(solution) + system.support_offset(state.u, theta, load)
            step = jnp.where(equations.solvable, step, jnp.nan)
            return _FullStep(step, definite, before.tries + 1)

        most = jnp.where(again, 2, 1)
        full = while_loop(lambda t: ~t.definite & (t.tries < most), attempt, first)
        state = state._replace(refused=jnp.where(full.tries > 1, state.refused + 1, 0))
        refused = state._replace(fraction=jnp.zeros(()), definite=full.definite)
        return cond(full.definite, lambda: self._advance(state, full.step), lambda: refused)

    def _advance(self, state: StressState, step: jax.Array) -> StressState:
        """Return the state after the part of a step that inverts no element."""
        system = self.system
        admissible = system.keeps_volume(state.u, step, self.shrink)
        fraction = largest_admissible(admissible, _SHORTEST)
        u, measures = _advanced(system, state.u, state.measures, self.theta, step, fraction)
        _, error = system.admissible_balance(u, self.theta, self.load)
        return state._replace(
            u=u, measures=measures, error=error, fraction=fraction, definite=jnp.array(True)
        )


@compiled
def _measures_of(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Return the strain measures (b, q, k) of the displacement ``u`` (n, 3) mm."""
    scene, measures = system.scene, MaterialPoint(system.scene, theta).measures
    measures_at = lambda H, at: measures.of(H, at.directions)  # noqa: E731
    return at_points(measures_at, law_gradients(scene, u), scene.block_tissue_at(theta))


@compiled
def _equations(
    system: System,
    u: jax.Array,
    measures: jax.Array,
    theta: jax.Array,
    load: jax.Array,
    load_stiffness: jax.Array,
    geometric: Number,
) -> Linearised:
    """Return the equations of a step."""
    scene, point = system.scene, MaterialPoint(system.scene, theta)

    def linearise(H: jax.Array, xi: jax.Array, at: Tissue) -> tuple[jax.Array, ...]:
        return point.linearise(H, xi, at, geometric)

    tissue = scene.block_tissue_at(theta)
    stress, moduli, known = at_points(linearise, law_gradients(scene, u), measures, tissue)
    forces, bulk = block_derivatives(scene, u, stress, moduli, known)
    residual = system.residual_of(forces, u, theta, load)
    tangent, solvable, offset_force = system.equations(bulk, u, theta, load_stiffness, load)
    return Linearised(tangent, solvable, residual, offset_force)


@compiled
def _advanced(
    system: System,
    u: jax.Array,
    measures: jax.Array,
    theta: jax.Array,
    step: jax.Array,
    fraction: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Return the displacement (n, 3) mm and measures (m, q, k) after ``fraction`` of the step."""
    scene, point = system.scene, MaterialPoint(system.scene, theta)
    H, change = jax.jvp(lambda v: law_gradients(scene, v), (u,), (step,))
    after = at_points(point.at_stress, H, change, measures, scene.block_tissue_at(theta))
    advances = fraction > 0.0
    return jnp.where(advances, u + fraction * step, u), jnp.where(advances, after, measures)


def applies(scene: Scene) -> bool:
    """Return whether stresses can be unknowns of a scene, and whether that saves time.

    Its law must be exponential and read nothing but measures.
    """
    return scene.law.exponential and measures_read(scene.law) is not None
