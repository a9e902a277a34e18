r"""One iteration of Newton's method at a fixed load factor: direction, then step length.

.. math::
    K\, \Delta u = -\left[r_s(u) + K\, \Delta \bar u\right], \qquad
    \Delta \bar u = s \bar u - u|_\text{prescribed}

at load factor s, where the loads are :math:`s f` and the prescribed displacements :math:`s \bar u`.
Where the tangent is indefinite and the direction raises the potential, the opposite one is taken.
The step is taken whole where the residual alone shows that it is good, and otherwise by a line
search (:func:`backtrack`) for the largest fraction :math:`\alpha \in \{1, \tfrac12, \tfrac14,
\dots\}` that keeps every element's :math:`J` above a fraction of its present least value and lowers
the potential energy by Armijo's rule,

.. math::
    \Pi(u + \alpha \Delta u) \le \Pi(u) + 10^{-4}\, \alpha\, r \cdot \Delta u .

Exponential laws diverge without it (docs/experiments.md, "Newton's steps: guard J only, or ask for
descent"). An accepted fraction is halved again while that lowers the potential further: a soft
start overshoots, and from there the tangent is indefinite and the way back long. Loads without a
potential keep their present force while a step is judged. Loops carry their decisions as state, so
that conditions read a flag: under ``vmap`` a condition that evaluates the potential itself never
returned on a ventricle.

Two measures save factorisations, which are most of the cost. The tangent of the last iteration is
kept while a step with it cuts the residual at least tenfold. And while the loads are hardly
balanced, as at rest, their stiffness is left out of the tangent.

The unknowns besides the displacement, and the linearisation, are the formulation's
(:mod:`emulator.fem.formulations`). Load factors are chosen in :mod:`emulator.fem.load_stepping`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled, cond, while_loop
from emulator.fem.formulations import Linearised, formulation_of
from emulator.fem.linear import Outcome
from emulator.fem.linear.reuse import ACCURACY
from emulator.fem.solution import NewtonState

# Relative residual below which the residual alone judges a step, and Newton's method takes over
# from the stress iterates (docs/experiments.md, "Stresses as iterates").
NEAR = 0.05
_LEAST_FRACTION = 2.0**-19
# A step that fails the monotonicity test fails early: a lower load is cheaper than many short steps
# (docs/experiments.md, "Mean dilatation from far away").
_LEAST_MONOTONE = 2.0**-6
# Least fraction that is halved because the potential falls further; below, the search has found a
# valley (docs/experiments.md, "Fewer factorisations from rest").
_SMALLEST_HALVED = 0.02
ARMIJO = 1e-4  # textbook value; the energy rarely comes close to this bound
_ROUND_OFF = 1e-13  # relative to the energy's parts; smaller decreases are round-off
_SINGULAR = 1e13  # ratio of step to force over stiffness from which the tangent is singular


@dataclass(frozen=True)
class NewtonOptions:
    """Options of the solver.

    tolerance : the largest norm of the residual relative to the internal and external forces,
        reactions included (docs/experiments.md, "The stopping rule of the released solutions").
    round_off : the relative residual that is accepted where Newton's method no longer reduces it.
    absolute : the residual in mN that is accepted whatever the forces; round-off of the forces at
        rest always is.
    max_iterations : the most iterations, of Newton's method and of stresses, over all fallbacks and
        load levels; no hard case that ends right needs more than 321 (studies/stability).
    level_iterations : the iterations after which a load level is given up and its increment halved.
    increment : the first and largest load increment, as a fraction of the load. Small increments
        follow the loading path from rest, for bodies with several equilibria (docs/experiments.md,
        "Several equilibria in the soft corner"); another start is then used only if it is already
        the solution.
    min_increment : the smallest load increment.
    shrink : the least fraction of the smallest ``J`` that a step keeps.
    keep_tangent : the fraction of the residual below which a step's tangent is used again; 0 is the
        full Newton method (docs/experiments.md, "Fewer factorisations from rest").
    stress_iterates : whether to begin, far from equilibrium, with
        :mod:`emulator.fem.stress_iterates` where the scene allows it (see ``applies``
        there); never with load increments (docs/experiments.md, "Stresses as iterates: the
        ventricle from rest in five factorisations").
    """

    tolerance: float = 1e-11
    round_off: float = 1e-8
    absolute: float = 0.0
    max_iterations: int = 330
    level_iterations: int = 40
    increment: float = 1.0
    min_increment: float = 1.0 / 256.0
    shrink: float = 0.2
    keep_tangent: float = 0.1
    stress_iterates: bool = True

    def __post_init__(self) -> None:
        if not self.min_increment <= self.increment <= 1.0:
            raise InputError(
                f"load increment {self.increment:g}: give {self.min_increment:g} (the least) to 1"
            )

    @classmethod
    def load_steps(cls, steps: int, most: int = max_iterations) -> NewtonOptions:
        """Return options that follow the loading path in ``steps`` increments, or smaller ones.

        most : the most iterations, or 20 a step if that is more.
        """
        if steps < 1:
            raise InputError(f"{steps} load steps; give 1 or more")
        return cls(increment=1.0 / steps, max_iterations=max(most, 20 * steps))


class Step(NamedTuple):
    """One iteration: Newton's full step, and the part of it that is taken.

    full : the displacement increment of the full step, (n, 3) mm.
    tangent : the nonzeros (nnz,) of the tangent that it was solved with, mN/mm.
    couplings : the data by which the formulation updates other unknowns, or None.
    refused : whether there is no step, because the tangent had to be positive definite and is not.
    definite : whether the factorisation found the tangent positive definite.
    singular : whether the tangent is singular.
    descends : whether the tangent's own direction lowers the potential, as far as that is known.
    u : the displacement after the part that is taken, (n, 3) mm.
    residual : the residual there, (f,) mN.
    relative_residual : the norm of the residual relative to the forces.
    fraction : the part taken, as a fraction of the full step; 0 where none makes progress.
    inverting : whether inverting elements forbade twice the fraction.
    """

    full: jax.Array
    tangent: jax.Array
    couplings: Any
    refused: jax.Array
    definite: jax.Array
    singular: jax.Array
    descends: jax.Array
    u: jax.Array
    residual: jax.Array
    relative_residual: jax.Array
    fraction: jax.Array
    inverting: jax.Array


_Part = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]
"""The last five entries of :class:`Step`."""
_TrialPart = tuple[_Part, jax.Array, jax.Array]
"""A trial part of a step, whether the line search has been used, and whether the trials end."""
_Descent = tuple[jax.Array, jax.Array, jax.Array]
"""A fraction of a step, its potential, and whether half of it may be lower."""


def newton_step(
    system: System,
    options: NewtonOptions,
    theta: jax.Array,
    state: NewtonState,
    allow_indefinite: jax.Array | bool = True,
) -> Step:
    """Return one iteration of Newton's method at the load factor of ``state``.

    allow_indefinite : whether to step with a tangent that is not positive definite.
    """
    u, load = state.u, state.load
    equations = formulation_of(system).linearise(state, theta)  # residual and tangent
    force = equations.residual + equations.offset_force
    solution, outcome = system.attempt(equations.tangent, -force, ACCURACY)
    indefinite = outcome == Outcome.INDEFINITE
    again = indefinite & allow_indefinite
    solution = cond(again, lambda: system.solve(equations.tangent, -force), lambda: solution)
    refused = indefinite & ~again

    on_supports, saddle = system.supports_met(u, theta, load), state.auxiliary is not None
    bare, reversible = equations._replace(couplings=None), on_supports & (not saddle)
    full, slope, singular = _full_step(system, u, theta, load, bare, reversible, solution)
    descends = ~on_supports | (slope <= 0.0) | saddle

    none = (u, state.residual, state.relative_residual, jnp.zeros(()), jnp.array(False))
    near = on_supports & (state.relative_residual < NEAR) & state.displacement_only

    def search() -> tuple[jax.Array, jax.Array]:
        return _line_search(system, options, theta, state, equations, full, slope, on_supports)

    def attempt(trial: _TrialPart) -> _TrialPart:
        """Take the full step where the residual shows that it is good; otherwise search along it.

        A kept tangent is worth a full step or none: its direction is not searched along.
        """
        searches = trial[1] | ~near
        fraction, inverting = cond(searches, search, lambda: (jnp.ones(()), jnp.array(False)))
        v = _advance(system, u, theta, full, fraction, load)
        residual, relative = system.admissible_balance(v, theta, load)
        J, J_before = system.least_volume_ratio(v), system.least_volume_ratio(u)
        good = (relative <= 0.5 * state.relative_residual) & (options.shrink * J_before < J)
        good |= searches
        part = v, residual, relative, fraction, inverting
        part = jax.tree.map(lambda yes, no: jnp.where(good, yes, no), part, none)
        return part, jnp.array(True), good | ~state.renew

    first = none, jnp.array(False), refused | (~near & ~state.renew)
    part = while_loop(lambda trial: ~trial[2], attempt, first)[0]
    tangent, couplings = equations.tangent, equations.couplings
    return Step(full, tangent, couplings, refused, ~indefinite, singular, descends, *part)


def _line_search(
    system: System,
    options: NewtonOptions,
    theta: jax.Array,
    state: NewtonState,
    equations: Linearised,
    step: jax.Array,
    slope: jax.Array,
    on_supports: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Return the fraction of ``step`` to take, and whether inverting elements forbade twice it.

    The fraction is 0 where none makes progress.
    """
    u, load = state.u, state.load
    admissible = system.keeps_volume(u, step, options.shrink)
    test = formulation_of(system).monotonicity_test(state, theta, equations, step)
    if test is not None:
        # Round-off cannot be distinguished from progress, so it passes the test.
        unclear = state.relative_residual <= options.round_off
        trial = backtrack(admissible, lambda f: (unclear | test(f), jnp.zeros(())), _LEAST_MONOTONE)
        return jnp.where(trial.accepted, trial.fraction, 0.0), trial.inverting
    follower = system.follower_force(u, theta)

    def potential(fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
        return system.potential(u + fraction * step, theta, load, follower)

    falls = armijo(potential, jnp.where(on_supports, -ARMIJO * jnp.abs(slope), jnp.inf))

    def progress(fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return Armijo's rule, or a smaller residual where loads have no potential."""
        lower, energy = falls(fraction)
        if system.forces:
            residual = system.balance(u + fraction * step, theta, load).residual
            squared_norm = jnp.sum(equations.residual**2)
            lower |= jnp.sum(residual**2) < (1.0 - ARMIJO * fraction) * squared_norm
        return lower, energy

    trial = backtrack(admissible, progress, _LEAST_FRACTION)

    def halve(at: _Descent) -> _Descent:
        fraction, least, _ = at
        energy = potential(0.5 * fraction)[0]
        lower = energy < least
        fraction = jnp.where(lower, 0.5 * fraction, fraction)
        return fraction, jnp.where(lower, energy, least), lower

    first = trial.fraction, trial.energy, on_supports & trial.accepted
    fraction = while_loop(lambda at: at[2] & (at[0] > _SMALLEST_HALVED), halve, first)[0]
    return jnp.where(trial.accepted, fraction, 0.0), trial.inverting


@compiled
def _full_step(
    system: System,
    u: jax.Array,
    theta: jax.Array,
    load: jax.Array,
    equations: Linearised,
    reversible: jax.Array,
    step: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the step (n, 3), residual . step before a reversal, and whether K is singular.

    reversible : whether a step that raises the potential is reversed.
    step : the solution (f,) of the equations.
    """
    force = equations.residual + equations.offset_force
    slope = jnp.vdot(equations.residual, step)
    # A step so long for its force can only come of a singular tangent.
    size = jnp.max(jnp.abs(equations.tangent)) * jnp.max(jnp.abs(step))
    singular = ~(size <= _SINGULAR * jnp.max(jnp.abs(force)))
    step = jnp.where(reversible & (slope > 0.0), -step, step)
    step = system.extend(step) + system.support_offset(u, theta, load)
    solvable = equations.solvable
    return jnp.where(solvable, step, jnp.nan), slope, ~solvable | singular


@compiled
def _advance(
    system: System,
    u: jax.Array,
    theta: jax.Array,
    step: jax.Array,
    fraction: jax.Array,
    load: jax.Array,
) -> jax.Array:
    """Return ``u`` (n, 3) mm after a fraction of the step."""
    u = jnp.where(fraction > 0.0, u + fraction * step, u)
    # A full step meets the prescribed displacements; setting them avoids the last bit of round-off.
    return jnp.where(fraction == 1.0, system.scene.on_supports(u, theta, level=load), u)


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
