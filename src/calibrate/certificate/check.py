r"""A check of a posterior against FEM, with as many solves as decide.

1. **Train.** FEM is solved at draws of the posterior, evenly spaced, around them, at draws of the
   prior, and along descents of its own misfit (:mod:`calibrate.certificate.runs`). A correction of
   the map is fitted to these runs (:mod:`calibrate.statistical_model.predictive`), and a pool of
   cheap points follows the corrected map's posterior (:mod:`calibrate.statistical_model.pool`).
   Further runs, in rounds, go where the correction is so uncertain that FEM may find the data
   likely after all.
2. **Test.** The other runs are at fresh points :math:`z_j` of the pool, drawn with probabilities
   :math:`a_j` that mix the corrected posterior, the draws' smoothed density, where FEM may find the
   data likely, the surroundings of the draws, and the whole pool (defensive mixture; Hesterberg
   1995). A moment under FEM is the corrected map's over the pool, plus FEM's change of it at these
   points (a control variate; Owen and Zhou 2000):

   .. math:: \hat\theta_\text{FEM} = \hat\theta_\text{pool} +
       \hat\theta\{\pi_\text{FEM} / (q a)\} - \hat\theta\{\pi_\text{corrected} / (q a)\}

Given the training runs, the tests are independent draws from a known density: the errors are honest
however good or bad the correction is, and small where it is good.

3. **Decide.** The check begins with 70 runs, with 50 where runs before it have taught the map
   (:mod:`calibrate.project.rounds`): these train the correction, too, and fewer go where it is
   uncertain. While they leave the verdict undecided there are twice as many, up to 200: the earlier
   ones train, and fresh points test. A figure is compared with its limit at each look, with an
   error wide enough for these three (:mod:`calibrate.certificate.verdict`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from calibrate.certificate.estimates import Tests, evidence_of
from calibrate.certificate.mesh import mesh_change
from calibrate.certificate.runs import FEMRunner, FEMRuns, correction_from, descend
from calibrate.certificate.verdict import Certificate, judge
from calibrate.importance.proposals import MOST_TEMPERED, Kernels, key_from, tempered
from calibrate.importance.weights import effective, normalised
from calibrate.posterior import Posterior
from calibrate.statistical_model import FEMLikelihood
from calibrate.statistical_model.pool import Pool
from calibrate.statistical_model.predictive import Predictive
from emulator.core.display import Stages, counting
from emulator.core.errors import InputError, check_arguments
from emulator.core.machine import one_blas_thread
from emulator.fem.solution import EquilibriumSolver
from emulator.surrogates.correction import Correction

_AT_MOST, _FEWEST = 200, 25  # FEM runs
_FEWEST_DESCENTS = 16  # runs with which descents reach an end
_ROUNDS = 5  # rounds of adaptive runs
_STABILITY = 20  # draws at which the sign of the tangent is examined


class _Shares(NamedTuple):
    """The number of FEM runs to begin with, and what shares of them train; the others test.

    at_draws, around, at_prior : at draws of the posterior, around them, and at draws of the prior.
    descents : along descents; where those are fewer than 16, ``few_descents``, up to 16.
    adaptive : where the correction is uncertain.
    """

    begin: int = 70
    at_draws: float = 0.15
    around: float = 0.1
    at_prior: float = 0.1
    descents: float = 0.08
    few_descents: float = 1.0 / 6.0
    adaptive: float = 0.12


# Earlier runs train the correction of a taught map; what they may have missed is sought as before.
_SHARES, _TAUGHT = _Shares(), _Shares(50, at_prior=0.14, few_descents=0.2, adaptive=0.04)


@dataclass(frozen=True, eq=False)
class Check:
    """A certificate and what it was made from.

    posterior : the posterior that was checked.
    tests : the FEM runs that tested the correction, and the pool they were drawn from.
    """

    certificate: Certificate
    posterior: Posterior
    tests: Tests

    @property
    def pool(self) -> Pool:
        """Cheap points; ``pool.corrected`` are their weights under the corrected map."""
        return self.tests.pool


def examine(
    posterior: Posterior,
    simulator: EquilibriumSolver,
    *,
    draws: int | None = None,
    at_most: int | None = None,
    mesh: int | None = None,
    seed: int = 0,
    deadline: float = np.inf,
    progress: bool = False,
    stages: Stages | None = None,
) -> Check:
    """Check ``posterior`` with FEM runs: 70 or 50, doubled up to 200 while it is undecided.

    Parameters
    ----------
    draws : the number of runs to begin with; alone, the number of runs.
    at_most : the number of runs up to which they are doubled while the verdict is undecided.
    mesh : the largest number of solves on the next finer mesh (:mod:`calibrate.certificate.mesh`),
        by default 30; 0 for none.
    deadline : the value of ``time.perf_counter`` after which runs are not doubled, and no more
        solves on the finer mesh begin.
    stages : the record of the seconds of each stage.

    Raises
    ------
    InputError
        The simulator is for another scene, the number of runs is too small, or ``at_most`` is below
        it.
    """
    taught_at = posterior.taught_at()
    share = _TAUGHT if taught_at else _SHARES
    count, most = _checked_counts(draws, at_most, mesh, share.begin)
    stages = Stages(show=False) if stages is None else stages
    predictive = Predictive(posterior.model, posterior.data, posterior.draws())
    rng = np.random.default_rng(seed)
    z = predictive.unconstrain(posterior.draws())
    with (
        one_blas_thread(),
        counting(total=count, desc="FEM check", disable=not progress, unit="run") as bar,
    ):
        solver = FEMRunner(predictive, FEMLikelihood(posterior.model, simulator), bar)
        with stages("FEM where the map was asked"):
            rows = np.linspace(0, len(z) - 1, max(round(share.at_draws * count), 5)).astype(int)
            at_draws = solver(z[rows], stability=_STABILITY, slopes=True)
            # Next to the draws the map may hide a part of the posterior, by an error that draws of
            # the prior are too far apart to show.
            surrounding = Kernels.surrounding(z, rng)
            beside = surrounding.sample(rng, max(round(share.around * count), 4))
            around = solver(beside, slopes=True)
            prior = predictive.prior_draws(key_from(rng), max(round(share.at_prior * count), 4))
            at_prior = solver(prior, slopes=True)
            # Only descents of FEM's own misfit lead to a mode that the map hides altogether.
            few = min(_FEWEST_DESCENTS, int(share.few_descents * count))
            descending = max(round(share.descents * count), few)
            descents, modes = descend(solver, at_prior, at_draws, z, descending, rng)
        training, total = FEMRuns.joined([at_draws, around, at_prior, descents]), count
        known = [FEMRuns.of_map(predictive, predictive.unconstrain(taught_at))] if taught_at else []
        with stages("correction, and FEM that tests it"):
            while True:
                training, pool = _train(solver, z, training, known, modes, count, most, rng)
                rows, log_drawn = pool.tests(total - len(training.z), rng)
                tests = Tests(pool, solver(pool.z[rows]), rows, log_drawn)
                runs = FEMRuns.joined([training, tests.runs])
                evidence = evidence_of(posterior, at_draws, training, tests, len(modes), rng)
                count = _further_runs(total, most) if time.perf_counter() < deadline else 0
                if judge(evidence).verdict != "undecided" or not count:
                    break
                # Earlier tests, whose solutions are kept, train with slopes; fresh points test.
                learned = replace(solver, bar=tqdm(disable=True))(tests.runs.z, slopes=True)
                training, total = FEMRuns.joined([training, learned]), total + count
                bar.total = total
        bar.close()
        with stages("finer mesh"):
            every = FEMRuns.joined([runs, *known])
            change = mesh_change(
                pool, simulator, every, mesh, rng, deadline=deadline, progress=progress
            )
    return Check(judge(replace(evidence, mesh=change)), posterior, tests)


def certify(posterior: Posterior, simulator: EquilibriumSolver, **options: Any) -> Certificate:
    """Return the certificate of :func:`examine`: ``posterior`` against FEM.

    ``options`` are those of :func:`examine`.
    """
    check_arguments(options, "certify", examine)
    return examine(posterior, simulator, **options).certificate


def _checked_counts(
    draws: int | None, at_most: int | None, mesh: int | None, begin: int
) -> tuple[int, int]:
    """Return the numbers of FEM runs, to begin with and at most."""
    most = (_AT_MOST if draws is None else draws) if at_most is None else at_most
    count = min(begin, most) if draws is None else draws
    if count < _FEWEST:
        raise InputError(f"certify: {count} FEM runs asked for; give {_FEWEST} or more")
    if mesh is not None and mesh < 0:
        raise InputError(f"certify: {mesh} solves on the finer mesh; give 0 or more")
    if most < count:
        raise InputError(f"certify: at most {most} FEM runs, but {count} to begin with")
    return count, most


def _train(
    solver: FEMRunner,
    z: np.ndarray,
    runs: FEMRuns,
    known: list[FEMRuns],
    modes: tuple[np.ndarray, ...],
    count: int,
    most: int,
    rng: np.random.Generator,
) -> tuple[FEMRuns, Pool]:
    """Return all training runs, and the pool under the correction fitted to them.

    Of ``count`` runs adaptive ones are a share; the whole check has ``most`` at most.

    known : runs that the map passes through; the correction is fitted to them, too.
    """
    predictive = solver.predictive

    def corrected(runs: FEMRuns) -> Correction:
        every = FEMRuns.joined([runs, *known])
        return correction_from(every, predictive, most + len(every.z) - len(runs.z))

    pool = Pool.search(predictive, corrected(runs), z, modes, rng)
    adaptive = (_TAUGHT if known else _SHARES).adaptive
    for size in _rounds(max(round(adaptive * count), 1)):
        chances = tempered(pool.log_explored, MOST_TEMPERED)
        if chances.any():
            points = pool.z[rng.choice(len(pool.z), size=size, p=chances)]
            runs = FEMRuns.joined([runs, solver(points, slopes=True)])
        pool = pool.corrected_by(corrected(runs))
        if effective(normalised(pool.log_explored)) < MOST_TEMPERED:
            pool = pool.stepped(pool.log_explored, rng)
    return runs, pool.polished(rng).redrawn(rng)


def _rounds(count: int) -> list[int]:
    """Return the numbers of adaptive runs of each round, which add up to ``count``."""
    rounds = min(_ROUNDS, count)
    return np.diff(np.round(count * np.arange(rounds + 1) / rounds).astype(int)).tolist()


def _further_runs(total: int, most: int) -> int:
    """Return how many runs follow ``total``: as many again, if the limit allows, or none.

    A remainder that is too small for a pass of its own is added to the last pass.
    """
    count = min(total, most - total)
    if most - total - count < _FEWEST:
        count = most - total
    return count if count >= _FEWEST else 0
