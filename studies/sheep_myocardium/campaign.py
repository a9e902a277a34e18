"""FEM's runs of a heart: over the box first, then where the posterior is, round by round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc
from studies.sheep_myocardium.curves import (
    Cube,
    Emulated,
    Fit,
    Runs,
    cubes,
    fit,
    forces,
    joined,
)
from studies.sheep_myocardium.doubts import KNOWN, UNKNOWN, doubts, known_to
from studies.sheep_myocardium.experiment import MODES, Heart
from studies.sheep_myocardium.inference import (
    ORTHOTROPIC,
    TIMES,
    Found,
    of_draws,
    sample,
    settled,
)
from studies.sheep_myocardium.moves import Modes
from studies.sheep_myocardium.process import next_runs
from studies.sheep_myocardium.solver import Solver, without_mesh


@dataclass(frozen=True)
class Plan:
    """Numbers of runs a cube.

    wide : over the box. rounds, each : after them, so many times so many of all cubes together, at
    draws where they tell most of q. power : that the likelihood is taken to meanwhile, but in the
    last, so that runs reach beyond the posterior. closer : more such rounds at most, of the
    posterior itself and of cubes that are not known, until all are. tests : at draws of it. again :
    times that there are more of them while the verdict is open, at most. meshes : at which a finer
    mesh is solved, too. steps : of a chain's warm-up, and of its draws.
    """

    wide: int = 12
    rounds: int = 4
    each: int = 45
    power: float = 0.5
    closer: int = 6
    tests: int = 30
    again: int = 5
    meshes: int = 2
    steps: int = 300


QUICK = Plan(wide=4, rounds=1, each=6, closer=0, tests=4, again=0, meshes=1, steps=50)
Meshes = tuple[list[Runs], list[Runs]]
"""Runs of the cubes at the same positions on their mesh and on a finer one."""
_POOL = 80  # draws that next runs are chosen from
_forces = jax.jit(jax.vmap(forces, (None, 0)))


class Learned(NamedTuple):
    """Runs of a heart's cubes, and what they say.

    doubt : before each round, the root mean square of :func:`.doubts` at draws, of the cube that is
    known least.
    """

    runs: list[Runs]
    fitted: Fit
    doubt: tuple[float, ...] = ()

    @property
    def size(self) -> int:
        """Runs of all cubes."""
        return sum(len(each.x) for each in self.runs)

    def more(self, fem: Solver, new: list[Runs]) -> Learned:
        """With ``new`` runs."""
        runs = [joined(pair) for pair in zip(self.runs, new, strict=True)]
        return Learned(runs, fit(fem.bodies, runs, self.fitted), self.doubt)


@dataclass(frozen=True, eq=False)
class Campaign:
    """What FEM says of a heart.

    bodies : its cubes. learned : what their runs say. meshes : runs at the same positions on the
    mesh and on a finer one. cubes : emulator of the cubes without the mesh's error. explored : the
    posterior by it. tests : runs that it was not fitted to, at the draws ``tested`` (t,) of
    ``explored``. seconds : it took.
    """

    heart: Heart
    bodies: list[Cube]
    learned: Learned
    meshes: Meshes
    cubes: Emulated
    explored: Found
    tested: np.ndarray
    tests: list[Runs]
    seconds: float

    @property
    def coarse(self) -> Emulated:
        """Emulator of the cubes with the mesh's error."""
        return self.learned.fitted.emulated

    @property
    def runs_a_cube(self) -> int:
        """Of the cube that has most, with tests."""
        return max(len(runs.x) for runs in self.learned.runs) + len(self.tests[0].x)

    @property
    def by_fem(self) -> np.ndarray:
        """Forces (t, 9, j) in N of the tests by FEM."""
        stacked = np.stack([test.force for test in self.tests], axis=1)
        return stacked.reshape(len(stacked), len(MODES), -1)

    @property
    def by_map(self) -> np.ndarray:
        """Forces (t, 9, j) in N of the tests by the emulator."""
        x = jnp.asarray(np.stack([test.x for test in self.tests], axis=1))
        return np.asarray(_forces(self.coarse, x)).reshape(len(x), len(MODES), -1)

    def mesh_differences(self) -> np.ndarray:
        """Log likelihoods (d,) of the data at all draws, with the mesh's error less without."""
        finer = np.asarray(self.cubes.finer).reshape(len(MODES), -1)
        draws = self.explored.draws
        on_mesh = of_draws(self.explored.of, draws["means"] / finer, draws["omega"])
        return on_mesh.sum(axis=1) - self.explored.log_likelihoods.sum(axis=1)

    def likelihood_differences(self) -> np.ndarray:
        """Log likelihoods (t,) of the data at the tests, FEM's less the emulators'.

        Both without the mesh's error; NaN where FEM failed.
        """
        finer = np.asarray(self.cubes.finer).reshape(len(MODES), -1)
        of = self.explored.of
        omega = self.explored.draws["omega"][self.tested]
        by = (self.by_fem, self.by_map)
        fem, cheap = (of_draws(of, m * finer, omega).sum(axis=1) for m in by)
        return fem - cheap


def _of_no_mesh(coarse: Emulated, there: Sequence[Runs], fine: Sequence[Runs]) -> Emulated:
    """The emulator of forces without the mesh's error, by runs ``there`` and ``fine`` ones."""
    each = [without_mesh(a.force, b.force) for a, b in zip(there, fine, strict=True)]
    return coarse._replace(finer=jnp.asarray(np.stack(each)))


def campaign(heart: Heart, plan: Plan, kept: Path | None, seed: int) -> Campaign:
    """The runs of a heart up to its first tests. Those in the folder ``kept`` are not solved again.

    Choices do not depend on what was kept.
    """
    began = perf_counter()
    bodies = cubes(heart)
    fem = Solver(heart, bodies, kept)
    boxes = [qmc.Sobol(bodies[0].unknowns, seed=seed + k).random_base2(4) for k in range(3)]
    runs = fem("wide", [2.0 * box[: plan.wide] - 1.0 for box in boxes])
    learned = Learned(runs, fit(bodies, runs))
    for number in range(plan.rounds):
        # Of a posterior with fewer terms, too: a term that is off is a corner of its own.
        law = "fibres" if number == 1 else ORTHOTROPIC
        power = plan.power if number < plan.rounds - 1 else 1.0
        emulated = learned.fitted.emulated
        found = sample(heart, emulated, seed + number, law, power=power, steps=plan.steps)
        learned = _round(fem, learned, found, plan, seed)
    rows = np.random.default_rng(seed).choice(len(found.positions), plan.meshes, replace=False)
    x = np.moveaxis(found.positions[rows], 1, 0)
    meshes = fem("mesh", x), fem.finer("mesh_finer", x)
    return _tested(fem, learned, meshes, found.modes, plan, seed, began)


def further(found: Campaign, plan: Plan, kept: Path | None, seed: int) -> Campaign:
    """With more tests, at other draws of the same posterior."""
    began = perf_counter() - found.seconds
    fem = Solver(found.heart, found.bodies, kept)
    rows, new = _tests(fem, found.learned, found.explored, plan, seed, len(found.tested))
    return replace(
        found,
        tested=np.concatenate([found.tested, rows]),
        tests=[joined(pair) for pair in zip(found.tests, new, strict=True)],
        seconds=perf_counter() - began,
    )


def again(found: Campaign, plan: Plan, kept: Path | None, seed: int) -> Campaign:
    """Its tests become runs; others are made at draws of the new posterior."""
    began = perf_counter() - found.seconds
    fem = Solver(found.heart, found.bodies, kept)
    learned = found.learned.more(fem, found.tests)
    return _tested(fem, learned, found.meshes, found.explored.modes, plan, seed, began)


def of_law(
    found: Campaign, law: str, plan: Plan, kept: Path | None, seed: int
) -> tuple[Found, Fit]:
    """The posterior by another law, after rounds where the orthotropic law's left it unknown.

    And what its cubes are fitted to.
    """
    fem = Solver(found.heart, found.bodies, kept)
    made = settled(found.heart, found.cubes, seed, law, steps=plan.steps)
    learned, made = _closed(fem, found.learned, found.meshes, made, plan, seed, UNKNOWN)
    return made, learned.fitted


def _closed(
    fem: Solver,
    learned: Learned,
    meshes: Meshes,
    found: Found,
    plan: Plan,
    seed: int,
    least: float = KNOWN,
) -> tuple[Learned, Found]:
    """A posterior without the mesh's error, after rounds until its draws are known to ``least``."""
    for _ in range(plan.closer):
        after = _round(fem, learned, found, plan, seed, least)
        if after is learned:
            break
        learned = after
        found = _without_error(fem, learned, meshes, found.modes, plan, seed, found.law)
    return learned, found


def _without_error(
    fem: Solver, learned: Learned, meshes: Meshes, known: Modes, plan: Plan, seed: int, law: str
) -> Found:
    """The posterior without the mesh's error."""
    emulated = _of_no_mesh(learned.fitted.emulated, *meshes)
    how = {"known": known, "steps": plan.steps, "times": TIMES}
    return settled(fem.heart, emulated, seed + learned.size, law, **how)


def _round(
    fem: Solver, learned: Learned, found: Found, plan: Plan, seed: int, least: float = 0.0
) -> Learned:
    """With runs of cubes, where they tell most of q at draws of ``found``.

    Of those whose root mean square of :func:`.doubts` is above ``least``, or none.
    """
    every = doubts(learned.fitted, found)
    doubt = known_to(every)
    told = ", ".join(f"{value:.2f}" for value in doubt)
    by = f"{fem.heart.name}, {found.law}, {learned.size} runs"
    print(f"{by}: log likelihood known to {told}", flush=True)
    unknown = doubt > least
    if not unknown.any():
        return learned
    each = plan.each // int(unknown.sum())
    chosen = []
    for k, asked in enumerate(unknown):
        rows = _pool(every[:, k], seed + learned.size)
        x = found.positions[rows, k]
        told_most = next_runs(learned.fitted.left(k, x), len(x), each) if asked else []
        chosen.append(x[told_most])
    law = "" if found.law == ORTHOTROPIC else f"_{found.law.replace(', ', '_')}"
    made = learned.more(fem, fem(f"round_{learned.size}{law}", chosen))
    return made._replace(doubt=(*learned.doubt, float(doubt.max())))


def _pool(doubt: np.ndarray, seed: int) -> np.ndarray:
    """Draws that runs are chosen from: half of them those that are known least, the others any."""
    order = np.argsort(-doubt)
    half = _POOL // 2
    return np.concatenate(
        [order[:half], np.random.default_rng(seed).permutation(order[half:])[:half]]
    )


def _tested(
    fem: Solver,
    learned: Learned,
    meshes: Meshes,
    known: Modes,
    plan: Plan,
    seed: int,
    began: float,
) -> Campaign:
    """The posterior without the mesh's error, and FEM at some of its draws."""
    explored = _without_error(fem, learned, meshes, known, plan, seed, ORTHOTROPIC)
    learned, explored = _closed(fem, learned, meshes, explored, plan, seed)
    rows, tests = _tests(fem, learned, explored, plan, seed, 0)
    return Campaign(
        fem.heart, fem.bodies, learned, meshes, explored.of.cubes, explored, rows, tests,
        perf_counter() - began,
    )  # fmt: skip


def _tests(
    fem: Solver, learned: Learned, explored: Found, plan: Plan, seed: int, done: int
) -> tuple[np.ndarray, list[Runs]]:
    """Draws (t,) behind those that are ``done``, and FEM there."""
    order = np.random.default_rng(seed + learned.size).permutation(len(explored.positions))
    rows = order[done : done + plan.tests]
    x = np.moveaxis(explored.positions[rows], 1, 0)
    return rows, fem(f"tests_{learned.size}_{done}", x)
