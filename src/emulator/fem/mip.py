r"""Newton's method from far away, with a stress of its own at every integration point.

An exponential law makes Newton's method in the displacement overshoot: the strain that a soft
tangent promises comes back as an enormous stress, and undoing it takes an iteration for each factor
of e. As a function of stress, the strain of such a law is a logarithm. So the strain measures
:math:`\xi` of each integration point (:mod:`emulator.mechanics.measures`) become iterates of their
own, :math:`\hat\xi`, with the stress :math:`s = \varphi'(\hat\xi)` and stiffness
:math:`C = \varphi''(\hat\xi)` that belong to them, and an iteration solves the linearised

.. math::
    \int \left[s + C\,(\xi(u) - \hat\xi)\right] \cdot \xi'(u) = f, \qquad
    K = \int \xi'^T C\, \xi' + s \cdot \xi''

for the step :math:`\Delta u`, which promises the stress :math:`s + C d` with
:math:`d = \xi + \xi' \Delta u - \hat\xi`. Each measure then goes as far along its part of d as
takes the law to that stress, a fraction :math:`\beta \in [0, 1]` of it (all of it where the law is
softer there than promised). Where :math:`\hat\xi = \xi(u)` this is Newton's method, and so are its
limit and its order.

This is the mixed integration point (MIP) Newton method of Magisano, Leonetti & Garcea (2017), made
for geometric nonlinearity, with measures in place of stress components so that any law that reads
nothing but measures has its inverse, one scalar equation each. A ventricle from rest takes four to
six full steps to a residual of a few percent, all with positive definite tangents.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System, balance
from emulator.fem.functional import at_points, displacement_gradient
from emulator.fem.line_search import largest_sound
from emulator.fem.linear import Outcome
from emulator.fem.material_point import MaterialPoint
from emulator.fem.programs import compiled, cond, while_loop
from emulator.mechanics.measures import Measures, measures_read
from emulator.scenes.regions import Tissue

_SHORTEST = 2.0**-4  # fraction of a step; where less is left, the ramp of loads is lost


class MipState(NamedTuple):
    """What the next iteration needs.

    u : (n, 3) mm. measures : (m, q, k), the strain measures that the stresses belong to.
    error : residual of u relative to the forces at work, supports met; inf before the first step.
    fraction : of the last step that was taken; below 1 where elements would have been crushed, 0
    where there was no step.
    definite : whether the tangent of the last step was positive definite.
    """

    u: jax.Array
    measures: jax.Array
    error: jax.Array
    fraction: jax.Array
    definite: jax.Array


class _Tried(NamedTuple):
    """A full step (n, 3) mm, whether its tangent was definite, and how many were tried."""

    move: jax.Array
    definite: jax.Array
    tries: jax.Array


@dataclass(frozen=True, eq=False)
class MipNewton:
    """The iteration for one theta at one load level.

    Parameters
    ----------
    system : the equations; its law must be one that reads measures only, see :func:`applies`.
    shrink : least fraction of the present smallest ``J`` that a step may leave.
    level : fraction of the loads.
    """

    system: System
    shrink: float
    theta: jax.Array
    level: jax.Array

    def begin(self, u: jax.Array) -> MipState:
        """The state at ``u`` (n, 3) mm that Newton's method would start from."""
        unknown = jnp.full((), jnp.inf, float)
        return MipState(u, _measures_of(self.system, u), unknown, jnp.ones(()), jnp.array(True))

    def step(
        self,
        state: MipState,
        stiffening: jax.Array,
        geometric: jax.Array | float = 1.0,
        again: jax.Array | bool = False,
    ) -> MipState:
        """One iteration.

        Its tangent has ``stiffening`` times the stiffness of the loads, and that of the stresses as
        at rest plus ``geometric`` times what they have changed since. With neither it is definite
        for most laws, however rough the field; ``again`` tries so where it is not.
        """
        first = _Tried(state.u, jnp.array(False), jnp.array(0))

        def attempt(before: _Tried) -> _Tried:
            known = jnp.where(before.tries == 0, 1.0, 0.0)
            values, solvable, residual = _promised(
                self.system,
                state.u,
                state.measures,
                self.theta,
                self.level,
                known * stiffening,
                known * geometric,
            )
            # On the way from rest each tangent is unlike the one before.
            full, outcome = self.system.attempt(values, -residual, near=False)
            move, definite = _promised_step(self.system, solvable, residual, full, outcome)
            return _Tried(move, definite, before.tries + 1)

        most = jnp.where(again, 2, 1)
        tried = while_loop(lambda t: ~t.definite & (t.tries < most), attempt, first)
        lost = state._replace(fraction=jnp.zeros(()), definite=tried.definite)
        return cond(tried.definite, lambda: self._moved(state, tried.move), lambda: lost)

    def _moved(self, state: MipState, move: jax.Array) -> MipState:
        """The state after as much of a step as crushes no element."""
        fraction = self._fraction(state.u, move)
        ahead, measures = _taken(self.system, state.u, state.measures, self.theta, move, fraction)
        _, error = balance(self.system, ahead, self.theta, self.level)
        return MipState(ahead, measures, error, fraction, jnp.array(True))

    def _fraction(self, u: jax.Array, move: jax.Array) -> jax.Array:
        """How much of a step crushes no element; 0 if almost none of it does."""
        floor = self.shrink * self.system.least_volume_ratio(u)
        return largest_sound(
            lambda fraction: floor < self.system.least_volume_ratio(u + fraction * move), _SHORTEST
        )


@compiled
def _measures_of(system: System, u: jax.Array) -> jax.Array:
    """Strain measures (m, q, k) of the displacement ``u`` (n, 3) mm."""
    names = measures_read(system.scene.law)
    assert names is not None, "see applies"
    measures, H = Measures(names), displacement_gradient(system.scene, u)
    return at_points(system.scene, lambda H, at: measures.of(H, at.directions), H)


@compiled
def _promised(
    system: System,
    u: jax.Array,
    measures: jax.Array,
    theta: jax.Array,
    level: jax.Array,
    stiffening: jax.Array,
    geometric: jax.Array | float,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Tangent (nnz,), whether it is solvable, and residual (f,)."""
    point, grid = MaterialPoint(system.scene, theta), system.scene.discretisation
    H = displacement_gradient(system.scene, u)

    def linearise(H: jax.Array, own: jax.Array, at: Tissue) -> tuple[jax.Array, jax.Array]:
        return point.linearise(H, own, at, geometric)

    stress, tangent = at_points(system.scene, linearise, H, measures)
    force = jnp.einsum("mq,mqij,mqaj->mai", grid.weights, stress, grid.gradients)
    residual = system.restrict(system.scatter(force) + system.others(u, theta, level))
    K = system.assemble(system.element_blocks(tangent), u, theta, stiffening)
    return system.pattern.safe_values(K), system.pattern.solvable(K), residual


@compiled
def _promised_step(
    system: System,
    solvable: jax.Array,
    residual: jax.Array,
    move: jax.Array,
    outcome: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The full step (n, 3) mm, NaN where there is none, and whether its tangent is definite."""
    definite = outcome == Outcome.OK
    if system.forces:  # not symmetric: at least the step goes down
        definite &= jnp.vdot(residual, move) <= 0.0
    return system.extend(jnp.where(solvable, move, jnp.nan)), definite


@compiled
def _taken(
    system: System,
    u: jax.Array,
    measures: jax.Array,
    theta: jax.Array,
    move: jax.Array,
    fraction: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Displacement (n, 3) mm and measures (m, q, k) after ``fraction`` of the step."""
    point = MaterialPoint(system.scene, theta)
    H, change = (displacement_gradient(system.scene, field) for field in (u, move))
    after = at_points(system.scene, point.at_stress, H, change, measures)
    taken = fraction > 0.0
    return jnp.where(taken, u + fraction * move, u), jnp.where(taken, after, measures)


def applies(system: System) -> bool:
    """Whether a scene's stresses can be iterates of their own, and whether that pays.

    Its law must be exponential and read measures only. Mean dilatation has volumes and pressures as
    iterates already.
    """
    law = system.scene.law
    return law.exponential and not system.mixed and measures_read(law) is not None
