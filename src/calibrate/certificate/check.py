r"""A check against FEM with a fixed number of solves.

1. **Train.** FEM at draws of the posterior, evenly spaced, around them, at draws of the prior, and
   where descents of its own misfit lead from those (:mod:`calibrate.certificate.descents`).
   What the map misses there is learned (:mod:`calibrate.certificate.correction`), and a pool of
   cheap points follows the corrected map's posterior wherever it leads
   (:mod:`calibrate.certificate.pool`). Further runs, in rounds, go where the correction is so
   uncertain that FEM may find the data likely after all.
2. **Test.** The other runs are fresh points :math:`z_j` of the pool, drawn with probabilities
   :math:`a_j` that mix the corrected posterior, the draws' smoothed density, where FEM may find the
   data likely, what surrounds the draws, and the whole pool (defensive mixture; Hesterberg 1995).
   A moment under FEM is the corrected map's over the pool, plus what FEM changes of it at these
   points (a control variate; Owen and Zhou 2000):

   .. math:: \hat\theta_\text{FEM} = \hat\theta_\text{pool} +
       \hat\theta\{\pi_\text{FEM} / (q a)\} - \hat\theta\{\pi_\text{corrected} / (q a)\}

Given the first half, the second is independent draws from a known density: the errors are
honest however good or bad the correction is, and small where it is good.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from calibrate.certificate.correction import Correction
from calibrate.certificate.descents import descend
from calibrate.certificate.estimates import (
    Tests,
    figures_of,
    missed_by,
    physics_of,
    sampling_of,
    tail_of,
)
from calibrate.certificate.evidence import Evidence
from calibrate.certificate.mesh import MOST_RUNS, mesh_change
from calibrate.certificate.misfit import DRAWS, misfits
from calibrate.certificate.pool import (
    MOST_TEMPERED,
    Pool,
    around_draws,
    corrected_again,
    polish,
    redrawn,
    search,
    step,
    tempered,
)
from calibrate.certificate.predictive import Predictive
from calibrate.certificate.runs import Runs, Solver, correction_from, joined
from calibrate.certificate.verdict import Certificate, judge
from calibrate.posterior import Posterior
from calibrate.samplers.importance import effective, normalised
from calibrate.samplers.registry import SAMPLERS
from calibrate.statistical_model import FEMLikelihood
from emulator.core.errors import InputError
from emulator.core.progress import counting
from emulator.fem import Simulator
from emulator.fem.campaign import executor

_FEM_RUNS = 200
_FEWEST = 25
# Shares of the runs that train the correction; the others test it.
_AT_DRAWS, _AROUND, _AT_PRIOR, _DESCENTS, _ADAPTIVE = 0.15, 0.1, 0.1, 0.08, 0.12
_FEWEST_DESCENTS = 16  # runs; fewer end nowhere
_ROUNDS = 5  # in which the adaptive ones are chosen
_STABILITY = 20  # draws at which the tangent's sign is asked for


@dataclass(frozen=True, eq=False)
class Check:
    """A certificate and what it was made from.

    posterior : that was checked. pool : cheap points; ``pool.corrected`` are their weights under
    the corrected map. tests : FEM runs that tested it. correction : what is added to the map.
    """

    certificate: Certificate
    posterior: Posterior
    predictive: Predictive
    pool: Pool
    tests: Tests
    correction: Correction


def examine(
    posterior: Posterior,
    simulator: Simulator,
    *,
    draws: int | None = None,
    at_most: int | None = None,
    mesh: int | None = None,
    seed: int = 0,
    scheduler: str | None = None,
    progress: bool = False,
) -> Check:
    """Check ``posterior`` with ``draws`` FEM runs, 200 by default.

    at_most : while these leave the verdict undecided, they are doubled, up to so many.
    mesh : solves on the next finer mesh (:mod:`calibrate.certificate.mesh`): 0 for none, up to 15;
        by default four more than there are unknowns.
    scheduler : address of a Dask scheduler whose workers solve; otherwise this process does.

    Raises
    ------
    InputError
        The simulator is for another scene, too few runs are asked for, or fewer at most, FEM has
        decided on the draws already, or a scheduler does not answer.
    """
    _refuse_fem_draws(posterior)
    count = _FEM_RUNS if draws is None else draws
    if count < _FEWEST:
        raise InputError(f"certify: {count} FEM runs asked for; give {_FEWEST} or more")
    if mesh is not None and not 0 <= mesh <= MOST_RUNS:
        raise InputError(f"certify: {mesh} solves on the finer mesh; give 0 to {MOST_RUNS}")
    predictive = Predictive(posterior.model, posterior.data)
    most = count if at_most is None else at_most
    if most < count:
        raise InputError(f"certify: at most {most} FEM runs, but {count} to begin with")
    sampling = sampling_of(posterior)
    rng = np.random.default_rng(seed)
    z = predictive.unconstrain(posterior.draws())
    # More threads than one for small matrices oversubscribe the cores: twice the time.
    with (
        threadpool_limits(1, user_api="blas"),
        executor(scheduler) as execute,
        counting(total=count, desc="FEM check", disable=not progress, unit="run") as bar,
    ):
        likelihood = FEMLikelihood(posterior.model, simulator, execute)
        solver = Solver(predictive, likelihood, bar)
        begun = _begin(solver, z, count, rng)
        training, spent = begun.runs, 0
        while True:
            training, correction, pool = _train(solver, z, begun.ends, training, count, most, rng)
            tests = _test(solver, pool, spent + count - len(training.z), rng)
            every = joined([training, tests.runs])
            spent = len(every.z)
            figures = figures_of(posterior, predictive, pool, tests)
            missed = missed_by(predictive, correction, pool, tests, every)
            chosen = pool.z[resampled(pool, DRAWS, rng)]
            evidence = Evidence(
                *figures,
                sampling,
                physics_of(begun.at_draws, training, tests, pool),
                tail_of(pool, tests, missed, len(begun.ends)),
                misfits(predictive, correction, chosen, _key(rng)),
            )
            if judge(evidence).verdict != "undecided" or spent >= most:
                break
            # Twice as many altogether; the earlier tests train, and fresh points test.
            count, training = min(spent, most - spent), every
            bar.total = spent + count
        bar.close()
        change = mesh_change(predictive, simulator, every, pool, mesh, rng, progress=progress)
    certificate = judge(replace(evidence, mesh=change))
    return Check(certificate, posterior, predictive, pool, tests, correction)


def certify(
    posterior: Posterior,
    simulator: Simulator,
    *,
    draws: int | None = None,
    at_most: int | None = None,
    mesh: int | None = None,
    seed: int = 0,
    scheduler: str | None = None,
    progress: bool = False,
) -> Certificate:
    """The certificate of :func:`examine`: ``posterior`` against ``draws`` FEM runs (200).

    While they leave the verdict undecided they are doubled, up to ``at_most`` if that is given.
    ``mesh`` is the number of solves on the next finer mesh, 0 for none. ``scheduler`` is the
    address of a Dask scheduler whose workers solve, as of :func:`calibrate.campaign`.
    """
    check = examine(
        posterior,
        simulator,
        draws=draws,
        at_most=at_most,
        mesh=mesh,
        seed=seed,
        scheduler=scheduler,
        progress=progress,
    )
    return check.certificate


def _refuse_fem_draws(posterior: Posterior) -> None:
    sampler = posterior.tree.attrs.get("sampler")
    if sampler in SAMPLERS and SAMPLERS[sampler].solves_fem:
        raise InputError(
            f"the posterior of sampler '{sampler}' is FEM's already; it needs no certificate"
        )


class _Begun(NamedTuple):
    """FEM where draws, their surroundings, the prior and descents are.

    at_draws : runs at draws. runs : all of them. ends : points around what else FEM finds likely.
    """

    at_draws: Runs
    runs: Runs
    ends: tuple[np.ndarray, ...]


def _begin(solver: Solver, z: np.ndarray, count: int, rng: np.random.Generator) -> _Begun:
    """The runs that any correction needs, their numbers in proportion to ``count``."""
    predictive = solver.predictive
    rows = np.linspace(0, len(z) - 1, max(round(_AT_DRAWS * count), 5)).astype(int)
    at_draws = solver(z[rows], stability=_STABILITY)
    # Next to the draws the map may hide a part of the posterior, by an error that draws of the
    # prior are too far apart to show.
    wide = solver(around_draws(z, rng).sample(rng, max(round(_AROUND * count), 4)))
    prior = predictive.prior_draws(_key(rng), max(round(_AT_PRIOR * count), 4))
    at_prior = solver(prior, slopes=True)
    # Where the map hides a mode altogether, only FEM leads to it.
    most = max(round(_DESCENTS * count), min(_FEWEST_DESCENTS, count // 6))
    found = descend(solver, at_prior, at_draws, z, most, rng)
    return _Begun(at_draws, joined([at_draws, wide, at_prior, found.runs]), found.ends)


def _train(
    solver: Solver,
    z: np.ndarray,
    ends: tuple[np.ndarray, ...],
    runs: Runs,
    count: int,
    most: int,
    rng: np.random.Generator,
) -> tuple[Runs, Correction, Pool]:
    """All training runs, the correction they say, and its pool.

    ends : points around what else FEM finds likely. runs : to begin with. most : of runs, ever.
    """
    predictive = solver.predictive
    correction = correction_from(runs, predictive, most)
    pool = search(predictive, correction, z, ends, rng)
    adaptive = max(round(_ADAPTIVE * count), 1)
    rounds = min(_ROUNDS, adaptive)
    for _ in range(rounds):
        chances = tempered(pool.log_explored, MOST_TEMPERED)
        if chances.any():
            size = round(adaptive / rounds)
            chosen = pool.z[rng.choice(len(pool.z), size=size, p=chances)]
            runs = joined([runs, solver(chosen)])
        correction = correction_from(runs, predictive, most)
        pool = corrected_again(pool, predictive, correction)
        if effective(normalised(pool.log_explored)) < MOST_TEMPERED:
            pool = step(pool, predictive, correction, pool.log_explored, rng)
    pool = polish(pool, predictive, correction, rng)
    return runs, correction, redrawn(pool, predictive, correction, rng)


def _test(solver: Solver, pool: Pool, count: int, rng: np.random.Generator) -> Tests:
    """FEM at fresh points of the pool, with the log density they were drawn from."""
    log_chances = pool.log_chances
    chances = np.exp(log_chances)
    rows = rng.choice(len(chances), size=count, p=chances / chances.sum())
    return Tests(solver(pool.z[rows]), rows, (pool.log_mixture + log_chances)[rows])


def resampled(pool: Pool, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rows (count,) of the pool as draws of the corrected map's posterior, in random order.

    Systematic resampling: each row comes as often as its weight says, up to one.
    """
    edges = np.cumsum(pool.corrected)
    at = (np.arange(count) + rng.uniform()) / count * edges[-1]
    return rng.permutation(np.minimum(np.searchsorted(edges, at), len(edges) - 1))


def _key(rng: np.random.Generator) -> jax.Array:
    return jax.random.key(int(rng.integers(2**31)))
