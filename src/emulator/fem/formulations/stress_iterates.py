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
nothing but measures has its inverse, one scalar equation each. With mean dilatation the measures
are those of the gradients that the law sees, so that a block's volume is one of them.

A ventricle from rest takes four to six full steps to a residual of a few percent, all with positive
definite tangents.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.balance import level_balance
from emulator.fem.condensation import block_derivatives
from emulator.fem.energy import at_points, displacement_gradient, seen_by_law
from emulator.fem.formulations.protocol import Linearised
from emulator.fem.halving import largest_sound
from emulator.fem.linear import Outcome
from emulator.fem.loop import compiled, cond, while_loop
from emulator.fem.material_point import MaterialPoint
from emulator.fem.system import System
from emulator.mechanics.measures import Measures, measures_read
from emulator.scenes.regions import Tissue
from emulator.scenes.scene import Scene

_SHORTEST = 2.0**-4  # fraction of a step; where less is left, the ramp of loads is lost


class StressState(NamedTuple):
    """What the next iteration needs.

    u : (n, 3) mm. measures : (m, q, k), the strain measures that the stresses belong to.
    error : residual of u relative to the forces at work; inf before the first step, and where the
    supports are not met.
    fraction : of the last step that was taken; below 1 where elements would have been crushed, 0
    where there was no step.
    definite : whether the tangent of the last step was positive definite.
    refused : steps in a row whose own tangent was not, and that were tried again.
    """

    u: jax.Array
    measures: jax.Array
    error: jax.Array
    fraction: jax.Array
    definite: jax.Array
    refused: jax.Array


class _Tried(NamedTuple):
    """A full step (n, 3) mm, whether its tangent was definite, and how many were tried."""

    move: jax.Array
    definite: jax.Array
    tries: jax.Array


@dataclass(frozen=True, eq=False)
class StressIterates:
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

    def begin(self, u: jax.Array) -> StressState:
        """The state at ``u`` (n, 3) mm that Newton's method would start from."""
        unknown, measures = jnp.full((), jnp.inf, float), _measures_of(self.system, u, self.theta)
        return StressState(u, measures, unknown, jnp.ones(()), jnp.array(True), jnp.array(0))

    def step(
        self,
        state: StressState,
        stiffening: jax.Array,
        geometric: jax.Array | float = 1.0,
        again: jax.Array | bool = False,
    ) -> StressState:
        """One iteration.

        Its tangent has ``stiffening`` times the stiffness of the loads, and that of the stresses as
        at rest plus ``geometric`` times what they have changed since. With neither it is definite
        for most laws, however rough the field; ``again`` tries so where it is not.
        """
        first = _Tried(state.u, jnp.array(False), jnp.array(0))

        def attempt(before: _Tried) -> _Tried:
            known = jnp.where(before.tries == 0, 1.0, 0.0)
            promised = _promised(
                self.system,
                state.u,
                state.measures,
                self.theta,
                self.level,
                known * stiffening,
                known * geometric,
            )
            force = promised.residual + promised.pull
            # On the way from rest each tangent is unlike the one before.
            full, outcome = self.system.attempt(promised.tangent, -force, near=False)
            move, definite = _promised_step(
                self.system,
                state.u,
                self.theta,
                self.level,
                promised.solvable,
                force,
                full,
                outcome,
            )
            return _Tried(move, definite, before.tries + 1)

        most = jnp.where(again, 2, 1)
        tried = while_loop(lambda t: ~t.definite & (t.tries < most), attempt, first)
        state = state._replace(refused=jnp.where(tried.tries > 1, state.refused + 1, 0))
        lost = state._replace(fraction=jnp.zeros(()), definite=tried.definite)
        return cond(tried.definite, lambda: self._moved(state, tried.move), lambda: lost)

    def _moved(self, state: StressState, move: jax.Array) -> StressState:
        """The state after as much of a step as crushes no element."""
        fraction = self._fraction(state.u, move)
        ahead, measures = _taken(self.system, state.u, state.measures, self.theta, move, fraction)
        _, error = level_balance(self.system, ahead, self.theta, self.level)
        taken = {"error": error, "fraction": fraction, "definite": jnp.array(True)}
        return state._replace(u=ahead, measures=measures, **taken)

    def _fraction(self, u: jax.Array, move: jax.Array) -> jax.Array:
        """How much of a step crushes no element; 0 if almost none of it does."""
        floor = self.shrink * self.system.least_volume_ratio(u)
        return largest_sound(
            lambda fraction: floor < self.system.least_volume_ratio(u + fraction * move), _SHORTEST
        )


def _seen(scene: Scene, u: jax.Array) -> jax.Array:
    """Displacement gradients (b, q, 3, 3) that the law sees at ``u`` (n, 3) mm."""
    return seen_by_law(scene, displacement_gradient(scene, u))


@compiled
def _measures_of(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Strain measures (b, q, k) of the displacement ``u`` (n, 3) mm."""
    scene, names = system.scene, measures_read(system.scene.law)
    assert names is not None, "see applies"
    measures = Measures(names)
    return at_points(
        lambda H, at: measures.of(H, at.directions), scene.block_tissue_at(theta), _seen(scene, u)
    )


@compiled
def _promised(
    system: System,
    u: jax.Array,
    measures: jax.Array,
    theta: jax.Array,
    level: jax.Array,
    stiffening: jax.Array,
    geometric: jax.Array | float,
) -> Linearised:
    """The equations of a step."""
    scene = system.scene
    point = MaterialPoint(scene, theta)

    def linearise(H: jax.Array, own: jax.Array, at: Tissue) -> tuple[jax.Array, ...]:
        return point.linearise(H, own, at, geometric)

    tissue = scene.block_tissue_at(theta)
    stress, moduli, known = at_points(linearise, tissue, _seen(scene, u), measures)
    forces, bulk = block_derivatives(scene, u, stress, moduli, known)
    residual = system.restrict(system.scatter(forces) + system.others(u, theta, level))
    tangent, solvable, pull = system.equations(bulk, u, theta, stiffening, level)
    return Linearised(tangent, solvable, residual, pull, None)


@compiled
def _promised_step(
    system: System,
    u: jax.Array,
    theta: jax.Array,
    level: jax.Array,
    solvable: jax.Array,
    force: jax.Array,
    move: jax.Array,
    outcome: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The full step (n, 3) mm, NaN where there is none, and whether its tangent is definite.

    force : (f,) mN that it balances.
    """
    definite = outcome == Outcome.OK
    if system.forces:  # not symmetric: at least the step goes down
        definite &= jnp.vdot(force, move) <= 0.0
    move = system.extend(move) + system.support_offset(u, theta, level)
    return jnp.where(solvable, move, jnp.nan), definite


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
    scene, point = system.scene, MaterialPoint(system.scene, theta)
    H, change = jax.jvp(lambda v: _seen(scene, v), (u,), (move,))
    after = at_points(point.at_stress, scene.block_tissue_at(theta), H, change, measures)
    taken = fraction > 0.0
    return jnp.where(taken, u + fraction * move, u), jnp.where(taken, after, measures)


def applies(scene: Scene) -> bool:
    """Whether a scene's stresses can be iterates of their own, and whether that pays.

    Its law must be exponential and read measures only.
    """
    return scene.law.exponential and measures_read(scene.law) is not None
