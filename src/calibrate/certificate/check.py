r"""A check against FEM with a fixed number of solves.

1. **Train.** FEM at draws of the posterior, evenly spaced, around them, and at draws of the prior.
   What the map misses there is learned (:mod:`calibrate.certificate.correction`), and a pool of
   cheap points follows the corrected map's posterior wherever it leads
   (:mod:`calibrate.certificate.pool`). Further runs, in rounds, go where the correction is so
   uncertain that FEM may find the data likely after all.
2. **Test.** The other runs are fresh points :math:`z_j` of the pool, drawn with probabilities
   :math:`a_j` that mix the corrected posterior, the map's, where FEM may find the data likely, and
   the whole pool (defensive mixture; Hesterberg 1995). A moment under FEM is the corrected map's
   over the pool, plus what FEM changes of it at these points (a control variate; Owen and Zhou
   2000):

   .. math:: \hat\theta_\text{FEM} = \hat\theta_\text{pool} +
       \hat\theta\{\pi_\text{FEM} / (q a)\} - \hat\theta\{\pi_\text{corrected} / (q a)\}

Given the first half, the second is independent draws from a known density: the errors are
honest however good or bad the correction is, and small where it is good.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from calibrate.certificate.correction import Correction
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
    effective,
    normalised,
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
from calibrate.samplers.registry import SAMPLERS
from calibrate.statistical_model import FEMLikelihood
from emulator.errors import InputError
from emulator.fem import Simulator
from emulator.fem.campaign import executor
from emulator.progress import counting

_FEM_RUNS = 200
_FEWEST = 25
# Shares of the runs that train the correction; the others test it.
_AT_DRAWS, _AROUND, _AT_PRIOR, _ADAPTIVE = 0.15, 0.1, 0.1, 0.2
_ROUNDS = 5  # in which the adaptive ones are chosen
# Shares of the test points: from the corrected posterior, the map's, where FEM may find the data
# likely, around the draws, and from the whole pool.
_CORRECTED, _MAP, _EXPLORED, _WIDE, _POOL = 0.55, 0.15, 0.1, 0.1, 0.1
_STABILITY = 20  # draws at which the tangent's sign is asked for


@dataclass(frozen=True, eq=False)
class Check:
    """A certificate and what it was made from.

    posterior : that was checked. pool : cheap points; ``pool.corrected`` are their weights under
    the corrected map. tests : FEM runs that tested it.
    """

    certificate: Certificate
    posterior: Posterior
    predictive: Predictive
    pool: Pool
    tests: Tests


def examine(
    posterior: Posterior,
    simulator: Simulator,
    *,
    draws: int | None = None,
    mesh: int | None = None,
    seed: int = 0,
    scheduler: str | None = None,
    progress: bool = False,
) -> Check:
    """Check ``posterior`` with ``draws`` FEM runs, 200 by default.

    mesh : solves on the next finer mesh (:mod:`calibrate.certificate.mesh`): 0 for none, up to 15;
        by default four more than there are unknowns.
    scheduler : address of a Dask scheduler whose workers solve; otherwise this process does.

    Raises
    ------
    InputError
        The simulator is for another scene, too few runs are asked for, FEM has decided on the
        draws already, or a scheduler does not answer.
    """
    _refuse_fem_draws(posterior)
    count = _FEM_RUNS if draws is None else draws
    if count < _FEWEST:
        raise InputError(f"certify: {count} FEM runs asked for; give {_FEWEST} or more")
    if mesh is not None and not 0 <= mesh <= MOST_RUNS:
        raise InputError(f"certify: {mesh} solves on the finer mesh; give 0 to {MOST_RUNS}")
    predictive = Predictive(posterior.model, posterior.data)
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
        at_draws, training, correction, pool = _train(solver, z, count, rng)
        tests = _test(solver, pool, count - len(training.z), rng)
        bar.set_description("finer mesh")
        change = mesh_change(predictive, simulator, joined([training, tests.runs]), pool, mesh, rng)
    chosen = pool.z[resampled(pool, DRAWS, rng)]
    draws_changes, corrected_changes, mean, sd = figures_of(posterior, predictive, pool, tests)
    evidence = Evidence(
        draws_changes,
        corrected_changes,
        mean,
        sd,
        sampling_of(posterior),
        physics_of(at_draws, training, tests, pool),
        tail_of(pool, tests, missed_by(predictive, correction, joined([training, tests.runs]))),
        misfits(predictive, correction, chosen, _key(rng)),
        change,
    )
    return Check(judge(evidence), posterior, predictive, pool, tests)


def certify(
    posterior: Posterior,
    simulator: Simulator,
    *,
    draws: int | None = None,
    mesh: int | None = None,
    seed: int = 0,
    scheduler: str | None = None,
    progress: bool = False,
) -> Certificate:
    """The certificate of :func:`examine`: ``posterior`` against ``draws`` FEM runs (200).

    ``mesh`` is the number of solves on the next finer mesh, 0 for none. ``scheduler`` is the
    address of a Dask scheduler whose workers solve, as of :func:`calibrate.campaign`.
    """
    check = examine(
        posterior,
        simulator,
        draws=draws,
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


def _train(
    solver: Solver, z: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[Runs, Runs, Correction, Pool]:
    """Runs at the posterior's draws, all training runs, the correction they say, and its pool."""
    predictive = solver.predictive
    rows = np.linspace(0, len(z) - 1, max(round(_AT_DRAWS * count), 5)).astype(int)
    at_draws = solver(z[rows], stability=_STABILITY)
    # Next to the draws the map may hide a part of the posterior, by an error that draws of the
    # prior are too far apart to show.
    wide = around_draws(z, rng).sample(rng, max(round(_AROUND * count), 4))
    prior = predictive.prior_draws(_key(rng), max(round(_AT_PRIOR * count), 4))
    runs = joined([at_draws, solver(wide), solver(prior)])
    correction = correction_from(runs, predictive, count)
    pool = search(predictive, correction, z, rng)
    for _ in range(_ROUNDS):
        chances = tempered(pool.log_explored, MOST_TEMPERED)
        if chances.any():
            size = max(round(_ADAPTIVE * count / _ROUNDS), 1)
            chosen = pool.z[rng.choice(len(pool.z), size=size, p=chances)]
            runs = joined([runs, solver(chosen)])
        correction = correction_from(runs, predictive, count)
        pool = corrected_again(pool, predictive, correction)
        if effective(normalised(pool.log_explored)) < MOST_TEMPERED:
            pool = step(pool, predictive, correction, pool.log_explored, rng)
    pool = polish(pool, predictive, correction, rng)
    return at_draws, runs, correction, redrawn(pool, predictive, correction, rng)


def _test(solver: Solver, pool: Pool, count: int, rng: np.random.Generator) -> Tests:
    """FEM at fresh points of the pool, with the log density they were drawn from."""
    even = np.full(len(pool.z), 1.0 / len(pool.z))
    chances = _CORRECTED * pool.corrected + _MAP * pool.cheap + _POOL * even
    chances += _WIDE * pool.around
    chances += _EXPLORED * normalised(pool.log_explored)
    chances = chances / chances.sum()
    rows = rng.choice(len(chances), size=count, p=chances)
    return Tests(solver(pool.z[rows]), rows, pool.log_mixture[rows] + np.log(chances[rows]))


def resampled(pool: Pool, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rows (count,) of the pool as draws of the corrected map's posterior, in random order.

    Systematic resampling: each row comes as often as its weight says, up to one.
    """
    edges = np.cumsum(pool.corrected)
    at = (np.arange(count) + rng.uniform()) / count * edges[-1]
    return rng.permutation(np.minimum(np.searchsorted(edges, at), len(edges) - 1))


def _key(rng: np.random.Generator) -> jax.Array:
    return jax.random.key(int(rng.integers(2**31)))
