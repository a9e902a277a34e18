r"""What a finer mesh would change of a posterior.

FEM at a few points of the posterior, on its mesh and on the next finer one
(:mod:`emulator.error.mesh_error`), differ in the data's space by :math:`D`, which varies little
over a posterior. A Gaussian process of theta continues it
(:mod:`calibrate.certificate.correction`). Added to what FEM on the mesh has shown of the map, it
gives a posterior with the finer mesh's FEM, and the pool follows that one; half of the points lie
in it. The change is from the corrected posterior to this one, over the same points of the pool. Its
error is the jackknife's over the solves on the finer mesh, and over the pool.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.certificate.correction import Correction, correct, fit, nothing
from calibrate.certificate.evidence import Figure, MeshChange
from calibrate.certificate.moments import jackknife, moments
from calibrate.certificate.pool import ENOUGH, Pool, corrected_again, effective, normalised, step
from calibrate.certificate.predictive import Predictive
from calibrate.certificate.runs import Runs
from calibrate.observations import Observations, observations_from_json
from emulator.error.mesh_error import MeshError, MeshErrorEstimate, mesh_error
from emulator.errors import InputError, SolverError
from emulator.fem import Simulator

MOST_RUNS = 15
_FEWEST = 4  # points
_ROUNDS = 12  # of the pool, on its way to a posterior that may be many sd away


def points_for(unknowns: int, states: int, most: int | None) -> int:
    """Points at which both meshes are solved, in every load state, with ``most`` solves on a mesh.

    By default four more than there are unknowns, and no more than 15 solves.
    """
    wanted = unknowns + 4 if most is None else MOST_RUNS
    return int(np.clip((most or MOST_RUNS) // states, _FEWEST, max(wanted, _FEWEST)))


@dataclass(frozen=True, eq=False)
class _Finer:
    """FEM on both meshes at points z."""

    predictive: Predictive
    error: MeshError
    observe: Observations

    def differences(self, z: np.ndarray) -> Iterator[np.ndarray | None]:
        """Finer mesh's data less the mesh's, flat (m,), of each point; None where FEM failed."""
        model = self.predictive.model
        draws = self.predictive.constrain(z)
        near: dict[int, MeshErrorEstimate] = {}
        for k in range(len(z)):
            thetas = model.states.thetas({name: values[k] for name, values in draws.items()})
            try:
                for s, theta in enumerate(thetas):
                    near[s] = self.error(theta, model.full(theta), near=near.get(s))
            except SolverError:
                yield None
                continue
            yield self._flat(self.observe, thetas, [near[s].fine for s in range(len(thetas))]) - (
                self._flat(model.observe, thetas, [near[s].coarse for s in range(len(thetas))])
            )

    @staticmethod
    def _flat(observe: Observations, thetas: jax.Array, fields: list[jax.Array]) -> np.ndarray:
        seen = jnp.stack([u[observe.nodes] for u in fields])
        return np.asarray(ravel_pytree(observe(seen, thetas))[0])


def mesh_change(
    predictive: Predictive,
    simulator: Simulator,
    runs: Runs,
    pool: Pool,
    count: int | None,
    rng: np.random.Generator,
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
        observe = observations_from_json(error.finer.scene, predictive.model.observe.to_json())
    except InputError as reason:
        return MeshChange(why=str(reason))
    found = _Finer(predictive, error, observe)
    states = len(predictive.model.states.states)
    return _change(found, runs, pool, points_for(predictive.dimension, states, count), rng)


def _change(
    finer: _Finer, runs: Runs, pool: Pool, count: int, rng: np.random.Generator
) -> MeshChange:
    predictive, scene = finer.predictive, finer.error.finer.scene
    nodes = len(scene.mesh.nodes)
    first = -(-count // 2)
    z, D = _solved(finer, _spread(pool, first, rng))
    corrected = _Corrected(predictive, runs)
    moved = _followed(pool, predictive, corrected(z, D), rng)
    more, others = _solved(finer, _spread(moved, count - first, rng))
    z, D = np.concatenate([z, more]), np.concatenate([D, others])
    failed = count - len(z)
    if len(z) < _FEWEST:
        return MeshChange(nodes=nodes, runs=count, failed=failed)
    correction = corrected(z, D)
    moved = _followed(moved, predictive, correction, rng)
    # Of the corrected posterior on the mesh, over the same points.
    before = corrected_again(moved, predictive, corrected(z[:0], D[:0])).corrected
    names = predictive.model.names
    here = predictive.constrain(moved.z)
    x = np.stack([here[name] for name in names], axis=1)

    def change(after: np.ndarray, used: np.ndarray) -> np.ndarray:
        p, old, new = len(names), moments(x, before * used), moments(x, after * used)
        return np.concatenate([(new - old)[:p] / np.exp(old[p : 2 * p]), (new - old)[p : 2 * p]])

    value, error = jackknife(lambda used: change(moved.corrected, used), len(x))
    everything = np.ones(len(x), dtype=bool)
    without = []
    for k in range(len(z)):
        kept = np.arange(len(z)) != k
        again = corrected_again(moved, predictive, corrected(z[kept], D[kept]))
        without.append(change(again.corrected, everything))
    spread = np.sum((np.array(without) - value) ** 2, axis=0) * (len(z) - 1) / len(z)
    error = np.sqrt(error**2 + spread)
    figures = [Figure(float(v), float(e)) for v, e in zip(value, error, strict=True)]
    p = len(names)
    return MeshChange(
        nodes=nodes,
        runs=count * len(predictive.model.states.states),
        failed=failed,
        shift=dict(zip(names, figures[:p], strict=True)),
        log_sd=dict(zip(names, figures[p:], strict=True)),
        linear=finer.error.simulator.scene.mesh.order == 1,
    )


@dataclass(frozen=True, eq=False)
class _Corrected:
    """Corrections of the map to FEM on the finer mesh, from runs on the mesh and differences."""

    predictive: Predictive
    runs: Runs

    def __call__(self, z: np.ndarray, D: np.ndarray) -> Correction:
        """The correction, from differences ``D`` (k, m) at points ``z`` (k, p); none for none."""
        predictive, runs = self.predictive, self.runs
        means, valid = predictive.means(runs.z)
        x = predictive.features(runs.z)
        fine = valid & runs.converged
        errors = runs.means - means
        if len(z):
            mesh = fit(predictive.features(z), D, predictive.scales, len(z))
            errors = errors + np.asarray(_values(mesh, x))
        if fine.sum() < x.shape[1] + 2:
            return nothing(len(runs.z), x.shape[1], means.shape[1])
        return fit(x[fine], errors[fine], predictive.scales, len(runs.z))


@jax.jit
def _values(correction: Correction, features: jax.Array) -> jax.Array:
    """The correction (s, m) at ``features`` (s, q)."""
    return jax.vmap(lambda x: correct(correction, x)[0])(features)


def _solved(finer: _Finer, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points (k, p) at which FEM converged on both meshes, and its differences (k, m)."""
    found = list(finer.differences(z))
    fine = np.array([difference is not None for difference in found], dtype=bool)
    width = len(finer.predictive.scales)
    kept = [difference for difference in found if difference is not None]
    return z[fine], np.array(kept).reshape(-1, width)


def _spread(pool: Pool, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points (count, p) of the corrected posterior, each once as far as there are any."""
    weights = pool.corrected
    rows = rng.choice(len(weights), size=count, p=weights)
    return pool.z[rows]


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
