r"""What a finer mesh would change of a posterior, or the grips of a specimen.

FEM is solved at a few points of the posterior, on its mesh and on the next finer one
(:mod:`emulator.accuracy.mesh_error`). For a specimen of homogeneous states the finer one is the
piece between its grips (:mod:`emulator.specimens.gripped`). The difference :math:`D` in the data
varies little over a posterior, and a Gaussian process of theta continues it
(:mod:`calibrate.statistical_model.predictive`). Added to the map's error on the mesh, it gives a
posterior under the finer mesh's FEM, and the pool follows that posterior. The change is from the
corrected posterior to this one, over the same points of the pool. Its error is the jackknife's over
the solves on the finer mesh, and over the pool.

Solves on the finer mesh are dear. The first four points lie in the corrected posterior; where they
leave no doubt, with twice the margin, there are no others. Otherwise half as many again follow, in
the posterior under the finer mesh's FEM as it is known by then, until every figure is decided.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from tqdm import tqdm

from calibrate.certificate.estimates import as_figures, jackknife, moments
from calibrate.certificate.evidence import (
    NOBODY_SAID,
    SAID_HOMOGENEOUS,
    MeshChange,
    all_within,
)
from calibrate.certificate.runs import FEMRuns
from calibrate.statistical_model.finer_fem import FinerFEM, Known, MeshPair, finer_fem
from calibrate.statistical_model.pool import Pool
from calibrate.statistical_model.predictive import Predictive
from emulator.accuracy.mesh_error import MeshErrorEstimate
from emulator.core.display import counting
from emulator.core.engine import Engine
from emulator.core.errors import InputError, SolverError
from emulator.core.rooms import offered
from emulator.fem import Simulator
from emulator.fem.campaign import in_order
from emulator.fem.solution import EquilibriumSolver
from emulator.scenes.scene import Scene
from emulator.surrogates.correction import Correction, corrections, fit_correction, no_correction

MOST_RUNS = 30
"""Default of the largest number of solves on the finer mesh."""
_FEWEST = 4  # least number of points at which both meshes are solved
_MARGIN = 2.0  # factor between a figure and its limit at which few points decide
_CANDIDATES = 4  # draws of which one is taken
_ROUNDS = 12  # steps of the pool towards a posterior that may be many sd away

WHERE = {
    "mesh": "on a finer mesh",
    "grips": "between its grips",
    "steps": "in steps half as long",
    "mesh and steps": "on a finer mesh, in steps half as long",
}
"""The place of the solves in words, by what is finer."""

Differences = Callable[[np.ndarray], Iterable[np.ndarray | None]]
"""FEM's data on a finer mesh less those on the mesh, flat (m,), of each point z (k, p).

None where FEM failed on one of the meshes.
"""

CorrectionBy = Callable[..., tuple[Correction, Correction]]
"""Points and differences to the map's correction and the differences' own: `_corrections_by`."""


def finer_of(mesh: Mapping[str, Any]) -> str:
    """Return what was finer in a certificate's JSON, which earlier versions said otherwise."""
    return str(mesh.get("of", "grips" if mesh.get("gripped") else "mesh"))


def points_for(unknowns: int, states: int, most: int | None) -> tuple[int, int]:
    """Return the numbers of points, solved in every load state, that may decide and that end it.

    A figure close to its limit is believed from four points more than there are unknowns.

    most : the largest number of solves on a mesh; by default 30.
    """
    largest = max((most or MOST_RUNS) // states, _FEWEST)
    return min(unknowns + 4, largest), largest


def mesh_change(
    pool: Pool,
    simulator: EquilibriumSolver,
    runs: FEMRuns,
    count: int | None,
    rng: np.random.Generator,
    *,
    deadline: float = np.inf,
    progress: bool = False,
) -> MeshChange:
    """Return the changes of the corrected posterior by the next finer mesh.

    Parameters
    ----------
    pool : the pool under the correction fitted to ``runs``.
    runs : all FEM runs of the check, on the mesh.
    count : the largest number of solves on the finer mesh, see :func:`points_for`; 0 for none.
    deadline : the value of ``time.perf_counter`` after which no points are added.
    """
    predictive = pool.predictive
    if count == 0:
        return MeshChange(why="not asked")
    if time.perf_counter() >= deadline:
        return MeshChange(why="no time was left (--budget)")
    scene = simulator.scene
    if not scene.refined_by:
        return MeshChange(why="its mesh is another program's, which only that one can refine")
    if not isinstance(scene, Scene) and not scene.components:
        (is_said_even,) = offered("calibrate.statistical_model.gripped_fem", "is_said_even")
        if (even := is_said_even(scene)) is not None:
            said = SAID_HOMOGENEOUS if even else NOBODY_SAID
            return MeshChange(why="its states are homogeneous on any mesh", homogeneous=said)
    elif isinstance(scene, Scene) and not isinstance(simulator, Simulator):
        return MeshChange(why="the simulator is not FEM's")
    try:
        finer = finer_fem(predictive.model, simulator)
    except InputError as reason:
        return MeshChange(why=str(reason))
    states = len(predictive.model.states.states)
    if count is not None and count < _FEWEST * states:
        few = f"{count} solves are fewer than {_FEWEST} points in {states} load states"
        return MeshChange(why=f"{few}: give --mesh-runs {_FEWEST * states}")
    points = points_for(pool.z.shape[1], states, count)
    with counting(
        total=points[1] * states, desc="finer mesh", disable=not progress, unit="solve"
    ) as bar:
        engine = getattr(simulator, "engine", None)
        differences = _differences_of_fem(predictive, finer, engine, bar)
        change = change_by(differences, pool, runs, points, rng, deadline=deadline)
    finer.forget()
    return replace(
        change,
        runs=change.runs * states,
        failed=change.failed * states,
        nodes=finer.nodes,
        linear=isinstance(scene, Scene) and scene.mesh.order == 1,
        of=finer.of,
        where=WHERE[finer.of],
    )


def _differences_of_fem(
    predictive: Predictive, finer: FinerFEM, engine: Engine | None, bar: tqdm
) -> Differences:
    """Return FEM's differences; each point starts from the finer solutions of earlier ones.

    Points that are solved at once start from the first point's, and from those of earlier calls,
    never from what another thread may or may not have finished.
    """
    known, difference = list[MeshErrorEstimate](), DifferenceOfFEM(finer)
    together = finer.workers > 1  # else each point starts from the one before it

    def differences(z: np.ndarray) -> Iterator[np.ndarray | None]:
        draws, later = predictive.constrain(z), list[MeshErrorEstimate]()
        points = (({n: values[k] for n, values in draws.items()}, known) for k in range(len(z)))
        pairs = in_order(difference, points, finer.workers, engine=engine if together else None)
        for number, pair in enumerate(pairs):
            if pair is not None:  # the first point is solved alone
                (later if number and together else known).extend(pair.estimates)
            bar.update(len(predictive.model.states.states))
            yield None if pair is None else pair.fine - pair.coarse
        known.extend(later)

    return differences


@dataclass(frozen=True)
class DifferenceOfFEM:
    """Solves at one point, in this process or in a worker's."""

    finer: FinerFEM

    def __call__(self, task: tuple[Mapping[str, Any], Known]) -> MeshPair | None:
        """Return the data at a draw, from the known solutions; None where FEM fails."""
        draw, known = task
        try:
            return self.finer(draw, known)
        except SolverError:
            return None


def change_by(
    differences: Differences,
    pool: Pool,
    runs: FEMRuns,
    points: tuple[int, int],
    rng: np.random.Generator,
    *,
    deadline: float = np.inf,
) -> MeshChange:
    """Return the changes of the corrected posterior by ``differences`` at a few points.

    points : the numbers of points that may decide and that end it, see :func:`points_for`.
    """
    correction_by = _corrections_by(pool.predictive, runs)
    enough, most = points
    z, D = _at_draws(differences, pool, _FEWEST, rng, pool.z[:0])
    asked, fine = _FEWEST, pool
    while True:
        change = MeshChange(runs=asked, failed=asked - len(z))
        if len(z) >= _FEWEST:
            correction, of_mesh = correction_by(z, D)
            fine = fine.corrected_by(correction).polished(rng, _ROUNDS, cheap=False)
            value, error = _change(fine, correction_by, z, D, of_mesh)
            names, p = pool.predictive.model.names, len(pool.predictive.model.names)
            figures = as_figures(value, error)
            change = replace(
                change,
                shift=dict(zip(names, figures[:p], strict=True)),
                log_sd=dict(zip(names, figures[p:], strict=True)),
            )
        comparisons = change.comparisons()
        decided = not comparisons or all_within(comparisons) is not None
        ended = asked >= most or time.perf_counter() >= deadline
        if ended or (decided and asked >= enough) or _leaves_no_doubt(change):
            return change
        more = min(max(asked // 2, 1), most - asked)
        more_z, more_D = _at_draws(differences, fine, more, rng, z)
        asked, z, D = asked + more, np.concatenate([z, more_z]), np.concatenate([D, more_D])


def _leaves_no_doubt(change: MeshChange) -> bool:
    """Return whether all figures are far within their limits, or one is far beyond."""
    figures = change.comparisons()
    far_within = [figure.within(limit / _MARGIN) is True for _, figure, limit in figures]
    far_beyond = [figure.within(limit * _MARGIN) is False for _, figure, limit in figures]
    return bool(figures) and (all(far_within) or any(far_beyond))


def _change(
    fine: Pool,
    correction_by: CorrectionBy,
    z: np.ndarray,
    D: np.ndarray,
    of_mesh: Correction,
) -> tuple[np.ndarray, np.ndarray]:
    """Return changes of means, in sd, and of log sds, (2 p,), and their errors.

    fine : the pool under the correction to the finer mesh's FEM.
    z, D : the points (k, p) at which both meshes were solved, and the differences (k, m).
    of_mesh : the fit to all differences, whose kernel those with one left out keep.
    """
    # The corrected posterior on the mesh, over the same points.
    before = fine.corrected_by(correction_by(z[:0], D[:0])[0]).corrected
    x = fine.predictive.on_scales(fine.predictive.columns(fine.z))
    p = x.shape[1]

    def change(after: np.ndarray, used: np.ndarray | float = 1.0) -> np.ndarray:
        old, new = moments(x, before * used), moments(x, after * used)
        return np.concatenate([(new - old)[:p] / np.exp(old[p : 2 * p]), (new - old)[p : 2 * p]])

    value, error = jackknife(lambda used: change(fine.corrected, used), len(x))
    leave_one_out = [
        change(fine.corrected_by(correction_by(z[remaining], D[remaining], of_mesh)[0]).corrected)
        for remaining in ~np.eye(len(z), dtype=bool)
    ]
    variance = np.sum((np.array(leave_one_out) - value) ** 2, axis=0) * (len(z) - 1) / len(z)
    return value, np.hypot(error, np.sqrt(variance))


def _corrections_by(predictive: Predictive, runs: FEMRuns) -> CorrectionBy:
    """Return the function from points z (k, p) and differences (k, m) to two corrections.

    The first one is the map's to FEM on the finer mesh, or without points to FEM on the mesh; the
    second one is the differences' own, whose kernel a third argument may set. All of the first
    kind have one kernel: a choice that flips between them would count as a change of the mesh.
    """
    means, valid = predictive.means(runs.z)
    x, usable = predictive.features(runs.z), valid & runs.converged
    errors_on_mesh = runs.means - means
    few, rows = usable.sum() < x.shape[1] + 2, len(runs.z)

    def fitted(errors: np.ndarray, like: Correction | None = None) -> Correction:
        if few:
            return no_correction(rows, x.shape[1], errors.shape[1])
        likely = runs.likely[usable]
        return fit_correction(x[usable], errors[usable], predictive.scales, rows, likely, like)

    on_mesh = fitted(errors_on_mesh)

    def correction_by(
        z: np.ndarray, D: np.ndarray, like: Correction | None = None
    ) -> tuple[Correction, Correction]:
        if not len(z):
            return on_mesh, on_mesh
        # Few runs do not continue the map's errors; the differences are continued by themselves.
        size = max(rows, len(z)) if few else len(z)
        points, scales = predictive.features(z), predictive.scales
        of_mesh = fit_correction(points, D, scales, size, like=like, exact=True)
        if few:
            return of_mesh, of_mesh
        errors = errors_on_mesh + np.asarray(corrections(of_mesh, x))
        return fitted(errors, like=on_mesh), of_mesh

    return correction_by


def _at_draws(
    differences: Differences, pool: Pool, count: int, rng: np.random.Generator, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return draws z (k, p) of the corrected posterior, and FEM's differences (k, m) there.

    They are chosen from four times as many: each is the one farthest from those before it and from
    ``known`` points (n, p). The differences are smooth, so a point close to another says nothing
    new. Draws at which FEM did not converge on both meshes are left out.
    """
    z = pool.z[rng.choice(len(pool.z), size=_CANDIDATES * count, p=pool.corrected)]
    x = pool.predictive.features(np.concatenate([known, z]))
    taken, x = x[: len(known)], x[len(known) :]
    distance = np.min(((x[:, None] - taken) ** 2).sum(axis=-1), axis=1, initial=np.inf)
    centre = int(np.argmin(((x - x.mean(axis=0)) ** 2).sum(axis=-1)))
    rows: list[int] = []
    for _ in range(count):
        first = not len(known) and not rows  # solves far away begin at the first one's
        rows.append(centre if first else int(np.argmax(distance)))
        distance = np.minimum(distance, ((x - x[rows[-1]]) ** 2).sum(axis=-1))
    every = list(differences(z[rows]))
    converged = np.array([difference is not None for difference in every], dtype=bool)
    D = np.array([difference for difference in every if difference is not None])
    return z[rows][converged], D.reshape(-1, len(pool.predictive.scales))
