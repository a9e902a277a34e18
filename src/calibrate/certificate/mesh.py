r"""What a finer mesh would change of a posterior.

FEM at a few points of the posterior, on its mesh and on the next finer one
(:mod:`emulator.accuracy.mesh_error`), differ in the data's space by :math:`D`, which varies little
over a posterior. A Gaussian process of theta continues it
(:mod:`calibrate.certificate.correction`). Added to what FEM on the mesh has shown of the map, it
gives a posterior with the finer mesh's FEM, and the pool follows that one; half of the points lie
in it. The change is from the corrected posterior to this one, over the same points of the pool. Its
error is the jackknife's over the solves on the finer mesh, and over the pool.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from tqdm import tqdm

from calibrate.certificate.correction import Correction, corrections, fit, nothing
from calibrate.certificate.evidence import Figure, MeshChange
from calibrate.certificate.moments import jackknife, moments
from calibrate.certificate.pool import ENOUGH, Pool, corrected_again, step
from calibrate.certificate.predictive import Predictive
from calibrate.certificate.runs import Runs
from calibrate.measurements import Observations
from calibrate.measurements.mesh_error import on_finer
from calibrate.samplers.importance import effective, normalised
from emulator.accuracy.mesh_error import MeshError, MeshErrorEstimate, mesh_error
from emulator.core.errors import InputError, SolverError
from emulator.core.progress import counting
from emulator.fem import Simulator
from emulator.fem.campaign import at_once, in_order

MOST_RUNS = 15
_FEWEST = 4  # points
_ROUNDS = 12  # of the pool, on its way to a posterior that may be many sd away


def points_for(unknowns: int, states: int, most: int | None) -> int:
    """Points at which both meshes are solved, in every load state, with ``most`` solves on a mesh.

    By default four more than there are unknowns, and no more than 15 solves.
    """
    wanted = unknowns + 4 if most is None else MOST_RUNS
    return int(np.clip((most or MOST_RUNS) // states, _FEWEST, max(wanted, _FEWEST)))


Differences = Callable[[np.ndarray], Iterable[np.ndarray | None]]
"""Data of FEM on a finer mesh less those on the mesh, flat (m,), of each point z (k, p).

None where FEM failed on one of the meshes.
"""


def mesh_change(
    predictive: Predictive,
    simulator: Simulator,
    runs: Runs,
    pool: Pool,
    count: int | None,
    rng: np.random.Generator,
    *,
    progress: bool = False,
) -> MeshChange:
    """What the next finer mesh changes of the corrected posterior.

    Parameters
    ----------
    runs : all of the check's FEM runs on the mesh. pool : under the correction they say.
    count : solves on the finer mesh, see :func:`points_for`; 0 asks nothing.
    """
    if count == 0:
        return MeshChange(why="not asked")
    if not isinstance(simulator, Simulator):
        return MeshChange(why="the simulator is not FEM's")
    try:
        error = mesh_error(simulator)
        observe = on_finer(error, predictive.model.observe)
    except InputError as reason:
        return MeshChange(why=str(reason))
    states = len(predictive.model.states.states)
    points = points_for(predictive.dimension, states, count)
    with counting(
        total=points * states, desc="finer mesh", disable=not progress, unit="solve"
    ) as bar:
        by_fem = _by_fem(predictive, error, observe, bar)
        told = changed(predictive, by_fem, runs, pool, points, rng)
    error.forget()
    nodes, linear = len(error.finer.scene.mesh.nodes), simulator.scene.mesh.order == 1
    model_error = predictive.model.error
    widened = model_error is not None and model_error.with_mesh
    return replace(told, runs=points * states, nodes=nodes, linear=linear, widened=widened)


def _by_fem(
    predictive: Predictive, error: MeshError, observe: Observations, bar: tqdm
) -> Differences:
    """FEM's differences; solves on the finer mesh begin near the first one, several at once."""
    model, near = predictive.model, dict[int, MeshErrorEstimate]()
    workers = at_once(error.simulator, len(error.finer.scene.mesh.nodes))

    def flat(seen: Observations, thetas: jax.Array, fields: list[jax.Array]) -> np.ndarray:
        stacked = jnp.stack([u[seen.nodes] for u in fields])
        return np.asarray(ravel_pytree(seen(stacked, thetas))[0])

    def one(thetas: jax.Array) -> np.ndarray | None:
        try:
            told = [
                error(theta, model.full(theta), near=near.get(s)) for s, theta in enumerate(thetas)
            ]
        except SolverError:
            return None
        for s, each in enumerate(told):
            near.setdefault(s, each)
        fine = flat(observe, thetas, [each.fine for each in told])
        return fine - flat(model.observe, thetas, [each.coarse for each in told])

    def differences(z: np.ndarray) -> Iterator[np.ndarray | None]:
        draws = predictive.constrain(z)
        each = ({name: values[k] for name, values in draws.items()} for k in range(len(z)))
        for found in in_order(one, map(model.states.thetas, each), workers):
            bar.update(len(model.states.states))
            yield found

    return differences


def changed(
    predictive: Predictive,
    differences: Differences,
    runs: Runs,
    pool: Pool,
    count: int,
    rng: np.random.Generator,
) -> MeshChange:
    """What ``differences`` at ``count`` points change of the corrected posterior."""
    first = -(-count // 2)
    corrected = _Corrected(predictive, runs)
    z, D = _solved(differences, _drawn(pool, first, rng), predictive)
    moved = _followed(pool, predictive, corrected(z, D), rng)
    more, others = _solved(differences, _drawn(moved, count - first, rng), predictive)
    z, D = np.concatenate([z, more]), np.concatenate([D, others])
    failed = count - len(z)
    if len(z) < _FEWEST:
        return MeshChange(runs=count, failed=failed)
    moved = _followed(moved, predictive, corrected(z, D), rng)
    # Of the corrected posterior on the mesh, over the same points.
    before = corrected_again(moved, predictive, corrected(z[:0], D[:0])).corrected
    names = predictive.model.names
    here = predictive.constrain(moved.z)
    x = np.stack([here[name] for name in names], axis=1)

    def change(after: np.ndarray, used: np.ndarray | float = 1.0) -> np.ndarray:
        p, old, new = len(names), moments(x, before * used), moments(x, after * used)
        return np.concatenate([(new - old)[:p] / np.exp(old[p : 2 * p]), (new - old)[p : 2 * p]])

    value, error = jackknife(lambda used: change(moved.corrected, used), len(x))
    without = [
        change(corrected_again(moved, predictive, corrected(z[kept], D[kept])).corrected)
        for kept in ~np.eye(len(z), dtype=bool)
    ]
    spread = np.sum((np.array(without) - value) ** 2, axis=0) * (len(z) - 1) / len(z)
    figures = [
        Figure(float(v), float(e)) for v, e in zip(value, np.hypot(error, spread**0.5), strict=True)
    ]
    shift, log_sd = figures[: len(names)], figures[len(names) :]
    return MeshChange(
        dict(zip(names, shift, strict=True)),
        dict(zip(names, log_sd, strict=True)),
        runs=count,
        failed=failed,
    )


@dataclass(frozen=True, eq=False)
class _Corrected:
    """Corrections of the map to FEM on the finer mesh, from runs on the mesh and differences."""

    predictive: Predictive
    runs: Runs

    def __call__(self, z: np.ndarray, D: np.ndarray) -> Correction:
        """The correction, from differences ``D`` (k, m) at points ``z`` (k, p); none for none."""
        predictive, runs = self.predictive, self.runs
        x, fine, errors = self._map
        if len(z):
            mesh = fit(predictive.features(z), D, predictive.scales, len(z))
            errors = errors + np.asarray(corrections(mesh, x))
        if fine.sum() < x.shape[1] + 2:
            return nothing(len(runs.z), x.shape[1], errors.shape[1])
        return fit(x[fine], errors[fine], predictive.scales, len(runs.z))

    @cached_property
    def _map(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Features of the runs, where map and FEM have an answer, and FEM's data less the map's."""
        means, valid = self.predictive.means(self.runs.z)
        return (
            self.predictive.features(self.runs.z),
            valid & self.runs.converged,
            self.runs.means - means,
        )


def _solved(
    differences: Differences, z: np.ndarray, predictive: Predictive
) -> tuple[np.ndarray, np.ndarray]:
    """The points (k, p) at which FEM converged on both meshes, and its differences (k, m)."""
    found = list(differences(z))
    fine = np.array([difference is not None for difference in found], dtype=bool)
    kept = [difference for difference in found if difference is not None]
    return z[fine], np.array(kept).reshape(-1, len(predictive.scales))


def _drawn(pool: Pool, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points (count, p) of the corrected posterior."""
    return pool.z[rng.choice(len(pool.z), size=count, p=pool.corrected)]


def _followed(
    pool: Pool, predictive: Predictive, correction: Correction, rng: np.random.Generator
) -> Pool:
    """``pool`` with points where the posterior under ``correction`` is."""
    pool = corrected_again(pool, predictive, correction)
    for _ in range(_ROUNDS):
        if effective(normalised(pool.log_corrected)) >= ENOUGH:
            break
        pool = step(pool, predictive, correction, pool.log_corrected, rng)
    return pool
