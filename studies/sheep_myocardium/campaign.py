"""FEM's runs of a heart: over the box first, then where the posterior is, round by round."""

from __future__ import annotations

import logging
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
    Found,
    log_likelihoods,
    sample,
    settled,
)
from studies.sheep_myocardium.process import next_runs

from emulator.store import replacing

LOG = logging.getLogger(__name__)
FINER = 5
"""Cells along an edge of the finer mesh: 1331 nodes."""
_ORDER = 1.2  # of the force's convergence: twice 0.595, the exponent at a glued edge


@dataclass(frozen=True)
class Plan:
    """Numbers of runs a cube.

    wide : over the box. each : a round, where they tell most of q at draws of the posterior.
    rounds : as many at least, at most; they end where q's sd at a tenth of the draws is below
    :data:`ENOUGH`. tests : at draws of the posterior, without slopes; as many again while these
    leave the verdict open, up to ``tests_at_most``. meshes : at which a finer mesh is solved, too.
    draws : of each of four chains.
    """

    wide: int = 12
    each: int = 9
    rounds: tuple[int, int] = (3, 7)
    tests: int = 30
    tests_at_most: int = 120
    meshes: int = 2
    draws: int = 300


QUICK = Plan(wide=4, each=2, rounds=(1, 1), tests=4, tests_at_most=4, meshes=1, draws=50)
ENOUGH = 0.01
"""Of a force: what q may be unsure of at a tenth of the draws when rounds end."""
_POOL = 80  # draws that next runs are chosen from


@dataclass(frozen=True, eq=False)
class Campaign:
    """What FEM says of a heart.

    bodies : its cubes. fitted : what their runs say. cubes : emulator of the cubes without the
    mesh's error. on_mesh, explored : the posteriors with the mesh's error and without. tests : runs
    that it was not fitted to, at the draws ``tested`` (t,) of ``explored``. doubt : of q at a tenth
    of the draws, by round. seconds : it took.
    """

    heart: Heart
    bodies: list[Cube]
    fitted: Fit
    cubes: Emulated
    on_mesh: Found
    explored: Found
    tested: np.ndarray
    tests: tuple[Runs, ...]
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
    def runs(self) -> int:
        """Runs a cube, tests included."""
        return int(self.fitted.known[0].used.sum()) + len(self.tests[0].x)

    @property
    def by_fem(self) -> np.ndarray:
        """Forces (t, 9, j) in N of the tests by FEM."""
        stacked = np.stack([test.force for test in self.tests], axis=1)
        return stacked.reshape(len(stacked), len(MODES), -1)

    @property
    def by_map(self) -> np.ndarray:
        """Forces (t, 9, j) in N of the tests by the emulator."""
        x = jnp.asarray(np.stack([test.x for test in self.tests], axis=1))
        each = jax.jit(jax.vmap(forces, (None, 0)))(self.coarse, x)
        return np.asarray(each).reshape(len(x), len(MODES), -1)

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
        each = jax.jit(jax.vmap(lambda of, m, o: log_likelihoods(of, m, o).sum(), (None, 0, 0)))
        omega = jnp.asarray(self.explored.draws["omega"][self.tested])
        fem, cheap = (np.asarray(each(of, m * finer, omega)) for m in (self.by_fem, self.by_map))
        return fem - cheap


def without_mesh(coarse: Emulated, tests: Sequence[Runs], fine: Sequence[Runs]) -> Emulated:
    """The emulator of forces without the mesh's error, by ``fine`` runs at some of the tests.

    The displacement at the edge of a glued face goes as :math:`r^{0.595}` in an incompressible
    body (Williams 1952, a right angle), the force therefore as :math:`h^{1.19}`: a factor
    :math:`1 + c` from 3 to 5 cells is :math:`1 + c / (1 - (3/5)^{1.2})` to none.
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
    unknowns = bodies[0].unknowns
    boxes = [qmc.Sobol(unknowns, seed=seed + k).random_base2(4) for k in range(3)]
    runs = [
        _kept(kept, f"{heart.name}_{k}_wide", body, 2.0 * box[: plan.wide] - 1.0)
        for k, (body, box) in enumerate(zip(bodies, boxes, strict=True))
    ]
    fitted = fit(bodies, runs)
    size = {"draws": plan.draws, "warmup": plan.draws}
    doubt: list[float] = []
    least, most = plan.rounds
    for number in range(most):
        names = [f"{heart.name}_{k}_round{number}" for k in range(3)]
        if (before := [_known(kept, name) for name in names]) and all(before):
            new = [each for each in before if each]
            runs = [joined(pair) for pair in zip(runs, new, strict=True)]
            fitted = fit(bodies, runs, fitted)
            continue
        law = "fibres" if number == 1 else ORTHOTROPIC
        found = sample(heart, fitted.emulated, seed + number, law, **size)
        pool = _some(found, _POOL, seed + number)
        left, sds = zip(*(fitted.left(k, pool[:, k]) for k in range(3)), strict=True)
        doubt.append(float(np.quantile(np.max(sds, axis=0), 0.9)))
        LOG.info("%s, round %d: q is known to %.1f %%", heart.name, number, 100 * doubt[-1])
        if number >= least and doubt[-1] < ENOUGH:
            break
        new = [
            _kept(kept, names[k], body, pool[next_runs(left[k], len(pool), plan.each), k])
            for k, body in enumerate(bodies)
        ]
        runs = [joined(pair) for pair in zip(runs, new, strict=True)]
        fitted = fit(bodies, runs, fitted)
    coarse = settled(heart, fitted.emulated, seed + most, **size)
    x = _some(coarse, plan.meshes, seed + most)
    pairs = []
    for cells in (CELLS, FINER):
        bodies_there = [replace(body, cells=cells) for body in bodies]
        pairs.append([
            _kept(kept, f"{heart.name}_{k}_mesh{cells}", body, x[:, k], slopes=False)
            for k, body in enumerate(bodies_there)
        ])  # fmt: skip
    cubes_there = without_mesh(fitted.emulated, *pairs)
    explored = settled(heart, cubes_there, seed + most, times=4, **size)
    untested = Campaign(
        heart, bodies, fitted, cubes_there, coarse, explored, np.zeros(0, dtype=int), (), doubt, 0.0
    )
    tested = tested_more(untested, plan.tests, kept, seed)
    return replace(tested, seconds=perf_counter() - began)


def tested_more(found: Campaign, count: int, kept: Path | None, seed: int) -> Campaign:
    """FEM at ``count`` more draws of the posterior."""
    began, before = perf_counter(), found.tested
    order = np.random.default_rng(seed).permutation(len(found.explored.positions))
    rows = order[len(before) : len(before) + count]
    number = len(before) // count
    new = [
        _kept(
            kept, f"{found.heart.name}_{k}_tests{number}", body,
            found.explored.positions[rows, k], slopes=False,
        )
        for k, body in enumerate(found.bodies)
    ]  # fmt: skip
    every = [joined(pair) for pair in zip(found.tests, new, strict=True)] if found.tests else new
    seconds = found.seconds + perf_counter() - began
    return replace(
        found, tested=np.concatenate([before, rows]), tests=tuple(every), seconds=seconds
    )


def _some(found: Found, count: int, seed: int) -> np.ndarray:
    """Positions (count, 3, p) of a posterior's draws.

    By a seed of its own, so that runs that are taken up again do not change later choices.
    """
    rows = np.random.default_rng(seed).choice(len(found.positions), count, replace=False)
    return found.positions[rows]


def _known(folder: Path | None, name: str) -> Runs | None:
    """What a file kept of a run before this one."""
    path = None if folder is None else folder / f"{name}.npz"
    if path is None or not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as arrays:
        return Runs(*(arrays[field] for field in Runs._fields))


def _kept(
    folder: Path | None, name: str, body: Cube, x: np.ndarray, *, slopes: bool = True
) -> Runs:
    """FEM at positions (r, p), or what a file kept of a run at these before this one."""
    known = _known(folder, name)
    if known is not None and known.x.shape == x.shape and np.allclose(known.x, x, atol=1e-9):
        return known
    found = body.runs(x, slopes=slopes)
    if folder is not None:
        path = folder / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **found._asdict())
    return found
