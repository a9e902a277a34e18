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
from studies.common.output import Case
from studies.sheep_myocardium.cube import CELLS
from studies.sheep_myocardium.curves import (
    Cube,
    Emulated,
    Runs,
    cubes,
    fit,
    forces,
    joined,
)
from studies.sheep_myocardium.experiment import MODES, Heart
from studies.sheep_myocardium.inference import (
    ORTHOTROPIC,
    Found,
    log_likelihoods,
    parameters,
    sample,
    seen,
)

from emulator.store import replacing

FINER = 5
"""Cells along an edge of the finer mesh: 1331 nodes."""
_ORDER = 1.6  # of the force's convergence


@dataclass(frozen=True)
class Plan:
    """Numbers of runs a cube.

    wide : over the box. rounds : of ``each`` at draws of two laws' posteriors in turn. tests : at
    draws of the last one. meshes : at which a finer mesh is solved, too.
    """

    wide: int = 12
    rounds: int = 4
    each: int = 7
    tests: int = 5
    meshes: int = 2
    draws: int = 300


QUICK = Plan(wide=4, rounds=1, each=2, tests=2, meshes=1, draws=50)


@dataclass(frozen=True, eq=False)
class Campaign:
    """What FEM says of a heart.

    coarse : emulator of its cubes. cubes : the same without the mesh's error. tests : runs that it
    was not fitted to, at draws. omega : mean of these draws. seconds : it took.
    """

    heart: Heart
    coarse: Emulated
    cubes: Emulated
    tests: tuple[Runs, ...]
    omega: float
    seconds: float

    @property
    def runs(self) -> int:
        """Runs a cube, tests included."""
        return self.coarse.at.shape[1] + len(self.tests[0].x)

    @property
    def by_fem(self) -> np.ndarray:
        """Forces (t, 9, j) in N of the tests by FEM."""
        stacked = np.stack([test.force for test in self.tests], axis=1)
        return stacked.reshape(len(stacked), len(MODES), -1)

    @property
    def by_map(self) -> np.ndarray:
        """Forces (t, 9, j) in N of the tests by the emulator."""
        x = jnp.asarray(np.stack([test.x for test in self.tests], axis=1))
        each = jax.jit(jax.vmap(lambda x: forces(self.coarse, x)))(x)
        return np.asarray(each).reshape(len(x), len(MODES), -1)

    def likelihood_differences(self) -> np.ndarray:
        """Log likelihoods (t,) of the data at the tests, FEM's less the emulators'."""
        of = seen(self.heart, self.coarse)
        each = jax.jit(jax.vmap(lambda m: log_likelihoods(of, m, jnp.asarray(self.omega)).sum()))
        fem, cheap = (np.asarray(each(m)) for m in (self.by_fem, self.by_map))
        return fem - cheap


def without_mesh(coarse: Emulated, tests: Sequence[Runs], fine: Sequence[Runs]) -> Emulated:
    """The emulator of forces without the mesh's error, by ``fine`` runs at some of the tests.

    That error falls as :math:`h^{1.6}` on cubes of 2, 4, 6 and 8 cells (docs/experiments.md,
    "Supports that theta moves"), so that a factor :math:`1 + c` from 3 to 5 cells is
    :math:`1 + c / (1 - (3/5)^{1.6})` to none.
    """
    factors = []
    for test, finer in zip(tests, fine, strict=True):
        change = np.nanmean(finer.force / test.force[: len(finer.x)], axis=0) - 1.0
        factors.append(1.0 + change / (1.0 - (CELLS / FINER) ** _ORDER))
    return coarse._replace(finer=jnp.asarray(np.stack(factors)))


def campaign(heart: Heart, plan: Plan, kept: Path | None, seed: int) -> Campaign:
    """The runs of a heart. Those in the folder ``kept`` are not solved again."""
    began = perf_counter()
    bodies = cubes(heart)
    rng = np.random.default_rng(seed)
    unknowns = bodies[0].unknowns
    boxes = [qmc.Sobol(unknowns, seed=seed + k).random_base2(4) for k in range(3)]
    wide = [2.0 * box[: plan.wide] - 1.0 for box in boxes]
    runs = [
        _kept(kept, f"{heart.name}_{k}_wide", body, x)
        for k, (body, x) in enumerate(zip(bodies, wide, strict=True))
    ]
    for number in range(plan.rounds + 1):
        last = number == plan.rounds
        fitted = fit(bodies, runs)
        law = "fibres" if number == 1 and not last else ORTHOTROPIC
        size = {"draws": plan.draws, "warmup": plan.draws, "chains": 1}
        found = sample(heart, fitted, seed + number, law, **size)
        rows = rng.choice(len(found.positions), plan.tests if last else plan.each, replace=False)
        name = "tests" if last else f"round{number}"
        new = [
            _kept(kept, f"{heart.name}_{k}_{name}", body, found.positions[rows, k])
            for k, body in enumerate(bodies)
        ]
        if not last:
            runs = [joined(pair) for pair in zip(runs, new, strict=True)]
    omega = float(found.draws["omega"].mean())
    fine = [
        _kept(
            kept, f"{heart.name}_{k}_finer", replace(body, cells=FINER), x.x[: plan.meshes],
            slopes=False,
        )
        for k, (body, x) in enumerate(zip(bodies, new, strict=True))
    ]  # fmt: skip
    cubes_there = without_mesh(fitted, new, fine)
    return Campaign(heart, fitted, cubes_there, tuple(new), omega, perf_counter() - began)


def _kept(
    folder: Path | None, name: str, body: Cube, x: np.ndarray, *, slopes: bool = True
) -> Runs:
    """FEM at positions (r, p), or what a file kept of a run before this one."""
    path = None if folder is None else folder / f"{name}.npz"
    if path is not None and path.is_file():
        with np.load(path, allow_pickle=False) as arrays:
            return Runs(*(arrays[field] for field in Runs._fields))
    found = body.runs(x, slopes=slopes)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **found._asdict())
    return found


def told(found: Campaign) -> Case:
    """Errors of the emulators at draws of the posterior, and what FEM changes of it."""
    errors = np.abs(found.by_map / found.by_fem - 1.0)
    return {
        "runs_a_cube": found.runs,
        "seconds": found.seconds,
        "error_median": float(np.nanmedian(errors)),
        "error_90": float(np.nanquantile(errors, 0.9)),
        "sd_of_log_likelihood_difference": float(np.nanstd(found.likelihood_differences())),
    }


def shifts(before: Found, after: Found) -> Case:
    """Changes of posterior means of logarithms, in sd."""
    found = {}
    for name in parameters(before.law):
        a, b = np.log(before.theta(name)), np.log(after.theta(name))
        found[name] = float((b.mean() - a.mean()) / a.std())
    return found
