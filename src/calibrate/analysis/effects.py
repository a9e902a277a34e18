"""Effects that may be left out of a scene, with their change of the observations and their time.

Everything is measured by FEM, the whole scene's runs against the simpler scene's at the same theta.
Effects that alone change every observation by no more than its tolerance, and whose absence saves
time, are left out one after the other, the one that saves most first, as long as they stay within
the tolerance together. The choice is then judged at theta that had no part in it; where it does not
hold there, the last effect left out comes back, and other theta judge again.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from calibrate.measurements import Observation, Observations, observations
from emulator.core.errors import InputError, SolverError, check_seed
from emulator.fem import Simulator, Solution, Status, sobol
from emulator.fem.energy import potential_energy
from emulator.scenes.effects import Effect, Onto, effects_of, leave_out
from emulator.scenes.scene import Scene

_ASIDE = 1e-7
_SAVES = 0.97  # share of the time; an effect is left out if the solves take less
_HELD_OUT = 1_000_003  # added to the seed to draw the theta that test the choice
_WORD = re.compile(r"([0-9.+-]+(?:[eE][+-]?[0-9]+)?)\s*(\S*)")


@dataclass(frozen=True)
class Measured:
    """The errors and the cost of a scene without some effects.

    changes : the largest change of each observation over theta and points; infinite where FEM
        failed.
    seconds : the median processor time of a solve from rest.
    ratio : the median over theta of that time over the whole scene's, which is solved just before,
        so that other work on the machine slows both.
    first_s : the processor time of the first solve in seconds, compilation included.
    operations : the floating-point operations of the energy and its gradient; None for a load
        without a potential.
    """

    left_out: tuple[str, ...]
    status: str
    changes: Mapping[str, float]
    seconds: float
    ratio: float
    first_s: float
    unknowns: int
    operations: float | None

    def within(self, tolerance: Mapping[str, float]) -> bool:
        """Whether no observation changes by more than its tolerance."""
        return all(self.changes[name] <= limit for name, limit in tolerance.items())


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The effects to leave out of a scene, and the measurements behind the recommendation.

    tolerance : the tolerance of each observation, in its unit.
    whole : the measurement of the scene as it is.
    alone : the measurements with each effect left out by itself.
    chosen : the measurement of the recommended scene, at theta that were not used for the choice.
    scene : the recommended scene.
    effects : the effects that can be left out of the scene, by name.
    """

    tolerance: Mapping[str, float]
    units: Mapping[str, str]
    whole: Measured
    alone: Sequence[Measured]
    chosen: Measured
    scene: Scene
    effects: Mapping[str, Effect] = field(repr=False)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the effects to leave out."""
        return self.chosen.left_out


def recommend(
    scene: Scene,
    observe: Observation | Mapping[str, Observation] | Observations,
    tolerance: Mapping[str, float] | float,
    *,
    samples: int = 6,
    seed: int = 0,
    say: Callable[[str], None] = lambda _: None,
) -> Recommendation:
    """Return the cheapest of the simpler scenes that keep the observations.

    Parameters
    ----------
    tolerance : the tolerance of each observation, in its unit, by name; or one number for one.
    samples : the number of theta at which each scene is solved; as many more test the choice.
    say : the function that is called with a sentence on what is being measured.

    Raises
    ------
    InputError
        No effect to leave out, a tolerance that is not above 0 or belongs to nothing observed, or
        fewer than 2 samples.
    SolverError
        FEM fails on the scene as it is.
    """
    observation_points = observations(observe)
    limits = _limits(observation_points, tolerance)
    if samples < 2:
        raise InputError(f"effects: {samples} samples; give 2 or more")
    check_seed(seed, "effects")
    effects = effects_of(scene)
    if not effects:
        raise InputError(f"scene '{scene.name}' has no effect that it can do without")
    compared = WithoutTerms(scene, observation_points, samples, seed, say)
    alone = [compared.without((name,)) for name in effects]
    chosen = _that_save(compared, alone, limits)
    whole = judged = compared.without(())
    trials = 0
    while chosen:
        trials += 1
        judge = WithoutTerms(
            scene, observation_points, samples, seed + trials * _HELD_OUT, say, compared.simulators
        )
        judged = judge.without(chosen)
        if judged.within(limits):
            break
        chosen, judged = chosen[:-1], whole
    return Recommendation(
        limits,
        {name: part.unit for name, part in observation_points.parts.items()},
        whole,
        alone,
        judged,
        leave_out(scene, chosen),
        effects,
    )


def _limits(observed: Observations, tolerance: Mapping[str, float] | float) -> Mapping[str, float]:
    """Return the tolerance of each observation by name; refuse several load states."""
    if observed.states != ("",):
        raise InputError("effects: observations of several load states; take one at a time")
    limits = observed.name(tolerance, "effects: tolerance")
    for name, limit in limits.items():
        if not 0.0 < limit < np.inf:
            raise InputError(f"effects: the tolerance of {name} is {limit:g}; it must be above 0")
    return limits


def _that_save(
    compared: WithoutTerms, alone: Sequence[Measured], limits: Mapping[str, float]
) -> tuple[str, ...]:
    """Return the effects that go together within the limits, each of which saves time.

    alone : what was measured without one effect each; the one that saves most is tried first.
    """
    chosen: tuple[str, ...] = ()
    best = compared.without(())
    for effect in sorted(alone, key=lambda m: m.ratio):
        if not effect.within(limits) or effect.ratio > _SAVES:
            continue
        trial = compared.without((*chosen, *effect.left_out))
        if trial.within(limits) and trial.ratio < _SAVES * best.ratio:
            chosen, best = (*chosen, *effect.left_out), trial
    return chosen


def tolerances(words: Sequence[str], observe: Observations) -> dict[str, float]:
    """Return each observation's tolerance from words such as ``0.5mm``, matched by their units."""
    by_unit: dict[str, float] = {}
    for word in words:
        match = _WORD.fullmatch(word.strip())
        try:
            value = float(match[1]) if match else float("nan")
        except ValueError:
            value = float("nan")
        if match is None or not np.isfinite(value):
            raise InputError(f"tolerance '{word}': write a number and its unit, e.g. 0.5mm")
        unit = match[2] or "1"
        if unit in by_unit:
            raise InputError(f"tolerance: two are given in {unit}; give one for each unit")
        by_unit[unit] = value
    units = {name: part.unit for name, part in observe.parts.items()}
    for unit in by_unit:
        if unit not in units.values():
            raise InputError(
                f"tolerance in {unit}: nothing observed has that unit; observed: "
                + ", ".join(f"{name} in {of}" for name, of in units.items())
            )
    for name, unit in units.items():
        if unit not in by_unit:
            raise InputError(f"tolerance: none for {name}; give one in {unit}, e.g. 0.5{unit}")
    return {name: by_unit[unit] for name, unit in units.items()}


class WithoutTerms:
    """Solves simpler scenes at the theta of one design and compares them with the whole one.

    simulators : the simulators so far, by the effects left out; new ones are added.
    """

    def __init__(
        self,
        scene: Scene,
        observe: Observations,
        samples: int,
        seed: int,
        say: Callable[[str], None] = lambda _: None,
        simulators: dict[tuple[str, ...], Simulator] | None = None,
    ) -> None:
        self._scene, self._observe, self._say = scene, observe, say
        self._thetas = sobol(scene, samples, seed)
        self.simulators = {} if simulators is None else simulators
        self._known: dict[tuple[str, ...], Measured] = {}
        self._values: list[dict[str, np.ndarray]] = []

    def without(self, names: tuple[str, ...]) -> Measured:
        """Return the comparison with the scene without these effects; it is measured once."""
        return self.of(names, lambda: leave_out(self._scene, names))

    def of(self, names: tuple[str, ...], make: Callable[[], Scene]) -> Measured:
        """Return the comparison with a scene whose parameters the whole scene has, too."""
        if names in self._known:
            return self._known[names]
        if names:
            self.without(())
        if names not in self.simulators:
            self.simulators[names] = Simulator(make())
        self._say(f"without {', '.join(names)}" if names else "the scene as it is")
        simulator, whole = self.simulators[names], self.simulators[()]
        simpler = simulator.scene
        onto = Onto(self._scene, simpler)
        first, _ = _clocked(simulator, simpler.centre)
        values, times, ratios, status = [], [], [], Status.CONVERGED
        for simpler_theta, theta in zip(onto.theta(self._thetas), self._thetas, strict=True):
            # Solvers keep factors of values they have seen: not the theta of the comparison again.
            whole_seconds = _clocked(whole, theta * (1.0 + _ASIDE))[0] if names else None
            seconds, solution = _clocked(simulator, simpler_theta)
            times.append(seconds)
            ratios.append(1.0 if whole_seconds is None else seconds / whole_seconds)
            status = Status(int(solution.status))
            if status is not Status.CONVERGED:
                break
            u = onto.field(solution.displacement)[self._observe.nodes]
            seen = self._observe(u[None], theta[None])
            values.append({name: np.asarray(value) for name, value in seen.items()})
        changes = dict.fromkeys(self._observe.parts, float("inf"))
        if not names:
            if status is not Status.CONVERGED:
                raise SolverError(f"effects: FEM of scene '{simpler.name}': {status.text}")
            self._values = values
        if status is Status.CONVERGED:
            pairs = list(zip(values, self._values, strict=True))
            for name in changes:
                changes[name] = max(_largest(mine[name] - its[name]) for mine, its in pairs)
        self._known[names] = Measured(
            left_out=names,
            status=status.text,
            changes=changes,
            seconds=float(np.median(times)),
            ratio=float(np.median(ratios)),
            first_s=first,
            unknowns=int((~simpler.held).sum()),
            operations=operations(simpler),
        )
        return self._known[names]


def _clocked(simulator: Simulator, theta: jax.Array) -> tuple[float, Solution]:
    """Return the processor seconds of a solve from rest, and its solution."""
    began = time.process_time()
    solution = jax.block_until_ready(simulator.solve(theta))
    return time.process_time() - began, solution


def operations(scene: Scene) -> float | None:
    """Return the floating-point operations of the compiled potential energy and its gradient."""
    if not all(load.has_potential for load in scene.loads):
        return None
    both = jax.jit(jax.value_and_grad(potential_energy(scene)))
    cost: Any = both.lower(np.zeros(scene.held.shape), scene.centre).compile().cost_analysis()
    return float(cost["flops"])


def _largest(change: np.ndarray) -> float:
    """Return the largest length of displacements (d, 3), or the largest size of other numbers."""
    if change.ndim == 2 and change.shape[1] == 3:
        return float(np.linalg.norm(change, axis=1).max())
    return float(np.abs(change).max())
