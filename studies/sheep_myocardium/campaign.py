"""FEM's runs of a heart: over the box first, then where the posterior is, round by round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc
from studies.sheep_myocardium.cube import CELLS
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
from studies.sheep_myocardium.experiment import MODES, Heart
from studies.sheep_myocardium.inference import (
    ORTHOTROPIC,
    TIMES,
    Found,
    of_draws,
    sample,
    settled,
)
from studies.sheep_myocardium.process import next_runs

from emulator.store import replacing

FINER = 5
"""Cells along an edge of the finer mesh: 1331 nodes."""
_ORDER = 1.2  # of the force's convergence: twice 0.595, the exponent at a glued edge


@dataclass(frozen=True)
class Plan:
    """Numbers of runs a cube.

    wide : over the box. rounds, each : after them, so many times so many, where they tell most of q
    at draws of the posterior. tests : at draws of the posterior. again : times that tests become
    runs, with one more round, and others are made, while the verdict is open. meshes : at which a
    finer mesh is solved, too. steps : of a chain's warm-up, and of its draws.
    """

    wide: int = 12
    rounds: int = 4
    each: int = 9
    tests: int = 30
    again: int = 5
    meshes: int = 2
    steps: int = 300


QUICK = Plan(wide=4, rounds=1, each=2, tests=4, again=0, meshes=1, steps=50)
_POOL = 80  # draws that next runs are chosen from
_forces = jax.jit(jax.vmap(forces, (None, 0)))


@dataclass(frozen=True, eq=False)
class Campaign:
    """What FEM says of a heart.

    bodies : its cubes. runs : of each. fitted : what they say. meshes : runs at the same positions
    on the mesh and on a finer one. cubes : emulator of the cubes without the mesh's error. on_mesh,
    explored : the posteriors with the mesh's error and without. tests : runs that it was not fitted
    to, at the draws ``tested`` (t,) of ``explored``. doubt : of q at nine draws of ten, by round.
    seconds : it took.
    """

    heart: Heart
    bodies: list[Cube]
    runs: list[Runs]
    fitted: Fit
    meshes: tuple[list[Runs], list[Runs]]
    cubes: Emulated
    on_mesh: Found
    explored: Found
    tested: np.ndarray
    tests: list[Runs]
    doubt: list[float]
    seconds: float

    @property
    def coarse(self) -> Emulated:
        """Emulator of the cubes with the mesh's error."""
        return self.fitted.emulated

    @property
    def omega(self) -> float:
        """Mean of its draws."""
        return float(self.explored.draws["omega"].mean())

    @property
    def runs_a_cube(self) -> int:
        """With tests."""
        return len(self.runs[0].x) + len(self.tests[0].x)

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

    @property
    def said(self) -> np.ndarray:
        """What the processes say their sd is at the tests, (t, 3), a fraction of the force."""
        each = [self.fitted.left(k, test.x)[1] for k, test in enumerate(self.tests)]
        return np.stack(each, axis=1)

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


def without_mesh(coarse: Emulated, there: Sequence[Runs], fine: Sequence[Runs]) -> Emulated:
    """The emulator of forces without the mesh's error, by runs ``there`` and ``fine`` ones.

    The displacement at the edge of a glued face goes as :math:`r^{0.595}` in an incompressible
    body (Williams 1952, a right angle), the force therefore as :math:`h^{1.19}`: a factor
    :math:`1 + c` from 3 to 5 cells is :math:`1 + c / (1 - (3/5)^{1.2})` to none.
    """
    factors = []
    for test, finer in zip(there, fine, strict=True):
        change = np.nanmean(finer.force / test.force, axis=0) - 1.0
        factors.append(1.0 + change / (1.0 - (CELLS / FINER) ** _ORDER))
    return coarse._replace(finer=jnp.asarray(np.stack(factors)))


@dataclass(frozen=True)
class Solver:
    """FEM of a heart's cubes. Runs in the folder ``kept`` are not solved again."""

    heart: Heart
    bodies: list[Cube]
    kept: Path | None

    def __call__(self, name: str, x: Sequence[np.ndarray]) -> list[Runs]:
        """Runs named ``name`` at positions (r, p) of each cube."""
        return [
            _kept(self.kept, f"{self.heart.name}_{k}_{name}", body, at)
            for k, (body, at) in enumerate(zip(self.bodies, x, strict=True))
        ]

    @property
    def finer(self) -> Solver:
        """Of the finer mesh."""
        return replace(self, bodies=[replace(body, cells=FINER) for body in self.bodies])


def campaign(heart: Heart, plan: Plan, kept: Path | None, seed: int) -> Campaign:
    """The runs of a heart up to its first tests. Those in the folder ``kept`` are not solved again.

    Choices do not depend on what was kept.
    """
    began = perf_counter()
    bodies = cubes(heart)
    fem = Solver(heart, bodies, kept)
    boxes = [qmc.Sobol(bodies[0].unknowns, seed=seed + k).random_base2(4) for k in range(3)]
    runs = fem("wide", [2.0 * box[: plan.wide] - 1.0 for box in boxes])
    fitted = fit(bodies, runs)
    doubt: list[float] = []
    for number in range(plan.rounds):
        # Of a posterior with fewer terms, too: a term that is off is a corner of its own.
        law = "fibres" if number == 1 else ORTHOTROPIC
        found = sample(heart, fitted.emulated, seed + number, law, steps=plan.steps)
        runs, fitted = _round(fem, runs, fitted, found, plan, seed, doubt)
    on_mesh = settled(heart, fitted.emulated, seed, known=found.modes, steps=plan.steps)
    x = np.moveaxis(_some(on_mesh, plan.meshes, seed), 1, 0)
    meshes = fem("mesh", x), fem.finer("mesh_finer", x)
    return _tested(fem, runs, fitted, meshes, on_mesh, plan, seed, doubt, perf_counter() - began)


def again(found: Campaign, plan: Plan, kept: Path | None, seed: int) -> Campaign:
    """Its tests become runs, with one more round; others are made at draws of the new posterior."""
    began = perf_counter()
    fem = Solver(found.heart, found.bodies, kept)
    runs = [joined(pair) for pair in zip(found.runs, found.tests, strict=True)]
    fitted = fit(found.bodies, runs, found.fitted)
    doubt = list(found.doubt)
    runs, fitted = _round(fem, runs, fitted, found.explored, plan, seed, doubt)
    how = {"known": found.explored.modes, "steps": plan.steps}
    on_mesh = settled(found.heart, fitted.emulated, seed + len(doubt), **how)
    seconds = found.seconds + perf_counter() - began
    return _tested(fem, runs, fitted, found.meshes, on_mesh, plan, seed, doubt, seconds)


def _round(
    fem: Solver,
    runs: list[Runs],
    fitted: Fit,
    found: Found,
    plan: Plan,
    seed: int,
    doubt: list[float],
) -> tuple[list[Runs], Fit]:
    """With runs where they tell most of q at draws of ``found``; its doubt is added."""
    number = len(doubt)
    pool = np.moveaxis(_some(found, _POOL, seed + number), 1, 0)
    left, sds = zip(*(fitted.left(k, pool[k]) for k in range(3)), strict=True)
    doubt.append(float(np.quantile(np.max(sds, axis=0), 0.9)))
    told = f"{fem.heart.name}, round {number + 1}: q is known to {100 * doubt[-1]:.1f} %"
    print(told, flush=True)
    chosen = [at[next_runs(C, _POOL, plan.each)] for at, C in zip(pool, left, strict=True)]
    new = fem(f"round{number}", chosen)
    runs = [joined(pair) for pair in zip(runs, new, strict=True)]
    return runs, fit(fem.bodies, runs, fitted)


def _tested(
    fem: Solver,
    runs: list[Runs],
    fitted: Fit,
    meshes: tuple[list[Runs], list[Runs]],
    on_mesh: Found,
    plan: Plan,
    seed: int,
    doubt: list[float],
    seconds: float,
) -> Campaign:
    """The posterior without the mesh's error, and FEM at some of its draws."""
    began, number = perf_counter(), len(doubt)
    cubes_there = without_mesh(fitted.emulated, *meshes)
    how = {"known": on_mesh.modes, "steps": plan.steps, "times": TIMES}
    explored = settled(fem.heart, cubes_there, seed + number, **how)
    rows = np.random.default_rng(seed + number).permutation(len(explored.positions))[: plan.tests]
    tests = fem(f"tests{number}", np.moveaxis(explored.positions[rows], 1, 0))
    seconds += perf_counter() - began
    return Campaign(
        fem.heart, fem.bodies, runs, fitted, meshes, cubes_there, on_mesh, explored, rows, tests,
        doubt, seconds,
    )  # fmt: skip


def _some(found: Found, count: int, seed: int) -> np.ndarray:
    """Positions (count, 3, p) of a posterior's draws, by a seed of their own."""
    rows = np.random.default_rng(seed).choice(len(found.positions), count, replace=False)
    return found.positions[rows]


def _kept(folder: Path | None, name: str, body: Cube, x: np.ndarray) -> Runs:
    """FEM at positions (r, p), or what a file kept of a run at these before this one."""
    path = None if folder is None else folder / f"{name}.npz"
    if path is not None and path.is_file():
        with np.load(path, allow_pickle=False) as arrays:
            known = Runs(*(arrays[field] for field in Runs._fields))
        if known.x.shape == x.shape and np.allclose(known.x, x, atol=1e-9):
            return known
    found = body.runs(x)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **found._asdict())
    return found
