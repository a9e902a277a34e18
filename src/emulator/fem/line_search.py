r"""Backtracking: the largest fraction of a step that is admissible and makes progress.

The fraction is the largest :math:`\alpha \in \{1, \tfrac12, \tfrac14, \dots\}` that keeps every
element's :math:`J` above a fraction of its present least value and lowers the potential energy by
Armijo's rule,

.. math::
    \Pi(u + \alpha \Delta u) \le \Pi(u) + 10^{-4}\, \alpha\, r \cdot \Delta u .

Exponential laws diverge without it (docs/experiments.md, "Newton's steps: guard J only, or ask for
descent"). The loop carries its decisions as state, so that its condition reads a flag: under
``vmap`` a condition that evaluates the potential itself never returned on a ventricle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.compiled import while_loop

ARMIJO = 1e-4  # textbook value; the energy rarely comes close to this bound
_ROUND_OFF = 1e-13  # relative to the energy's parts; smaller decreases are round-off

Admissible = Callable[[jax.Array], jax.Array]
"""Whether no element is near inversion after a fraction of the step."""
Progress = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
"""Whether a fraction of the step makes progress, and the potential there, mN mm."""


class Trial(NamedTuple):
    """A fraction of a step.

    fraction : the fraction of the full step, ().
    energy : the potential there, () in mN mm.
    accepted : whether the fraction is admissible and makes progress.
    admissible : whether no element is near inversion.
    inverting : whether twice the fraction was not admissible.
    """

    fraction: jax.Array
    energy: jax.Array
    accepted: jax.Array
    admissible: jax.Array
    inverting: jax.Array


def backtrack(admissible: Admissible, progress: Progress, least: float) -> Trial:
    """Halve the step until it is admissible and makes progress, or would go below ``least``."""

    def halve(trial: Trial) -> Trial:
        fraction = 0.5 * trial.fraction
        is_admissible, (lower, energy) = admissible(fraction), progress(fraction)
        return Trial(fraction, energy, is_admissible & lower, is_admissible, ~trial.admissible)

    def proceeds(trial: Trial) -> jax.Array:
        return ~trial.accepted & (trial.fraction >= 2.0 * least)

    no = jnp.array(False)
    twice = Trial(jnp.full((), 2.0), jnp.zeros(()), accepted=no, admissible=~no, inverting=no)
    return while_loop(proceeds, halve, twice)


def largest_admissible(admissible: Admissible, least: float) -> jax.Array:
    """Return the largest of 1, 1/2, 1/4, ... that is admissible; 0 if it is below ``least``."""
    trial = backtrack(admissible, lambda _: (jnp.array(True), jnp.zeros(())), least)
    return jnp.where(trial.accepted, trial.fraction, 0.0)


def armijo(
    potential: Callable[[jax.Array], tuple[jax.Array, jax.Array]], descent: jax.Array
) -> Progress:
    """Return whether the potential falls by a part of the full step's ``descent``, mN mm.

    potential : the potential after a fraction of the step, and the size of its parts.
    """
    energy, size = potential(jnp.zeros(()))
    ceiling = energy + _ROUND_OFF * size

    def progress(fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
        trial_energy = potential(fraction)[0]
        return trial_energy <= ceiling + fraction * descent, trial_energy

    return progress
