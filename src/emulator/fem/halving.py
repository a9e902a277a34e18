"""The largest of 1, 1/2, 1/4, ... of a step that will do.

The loop carries its verdicts as state, so that its condition reads a flag: under ``vmap`` a
condition that evaluates the potential itself never returned on a ventricle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.loop import while_loop


class Trial(NamedTuple):
    """A fraction of the step, its potential, and the verdicts on it.

    good : whether it is sound and makes progress. sound : whether no element is crushed.
    crushed : whether twice the fraction was not sound.
    """

    fraction: jax.Array
    energy: jax.Array
    good: jax.Array
    sound: jax.Array
    crushed: jax.Array


Judge = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
"""Of a fraction: whether it makes progress, and its potential, mN mm."""

ARMIJO = 1e-4  # textbook value; the energy is hardly ever near this bound
_ROUND_OFF = 1e-13  # of the energy's parts, in which a decrease near the solution drowns


def falls_enough(
    potential: Callable[[jax.Array], tuple[jax.Array, jax.Array]], descent: jax.Array
) -> Judge:
    """Whether the potential falls by a part of the whole step's ``descent``, mN mm (Armijo's rule).

    potential : of a fraction of the step, and the size of its parts.
    """
    energy, size = potential(jnp.zeros(()))
    ceiling = energy + _ROUND_OFF * size

    def judge(fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = potential(fraction)[0]
        return found <= ceiling + fraction * descent, found

    return judge


def largest_sound(sound: Callable[[jax.Array], jax.Array], least: float) -> jax.Array:
    """The largest of 1, 1/2, 1/4, ... that is ``sound``; 0 where that is below ``least``."""
    trial = largest_good(sound, lambda _: (jnp.array(True), jnp.zeros(())), least)
    return jnp.where(trial.good, trial.fraction, 0.0)


def largest_good(sound: Callable[[jax.Array], jax.Array], judge: Judge, least: float) -> Trial:
    """Halve the step until it is sound and makes progress, or would go below ``least``."""

    def halve(trial: Trial) -> Trial:
        fraction = 0.5 * trial.fraction
        fine, (lower, energy) = sound(fraction), judge(fraction)
        return Trial(fraction, energy, fine & lower, fine, ~trial.sound)

    def wanted(trial: Trial) -> jax.Array:
        return ~trial.good & (trial.fraction >= 2.0 * least)

    no = jnp.array(False)
    twice = Trial(jnp.full((), 2.0), jnp.zeros(()), good=no, sound=~no, crushed=no)
    return while_loop(wanted, halve, twice)
