"""The figures of a certificate, estimated from the pool and the FEM runs that test it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import logsumexp

from calibrate.certificate.correction import Correction
from calibrate.certificate.evidence import LARGEST_MASS, Changes, Figure, Physics, Sampling, Tail
from calibrate.certificate.moments import jackknife, moments
from calibrate.certificate.pool import Pool, with_guests
from calibrate.certificate.predictive import Predictive
from calibrate.certificate.runs import Runs, least_likely
from calibrate.posterior import Posterior
from calibrate.samplers.importance import effective, normalised, pareto_shape

_LIKELY = 0.99  # mass of the region that FEM's runs are likely in
_MISSED = 3.0  # in log likelihood: the corrected map finds a run 20 times less likely than FEM
# A part of FEM's posterior with this mass is met by a test with this probability.
_MASS, _MET = 0.1, 0.95


@dataclass(frozen=True, eq=False)
class Tests:
    """FEM at points of the pool: ``rows`` (n,), drawn from the log density ``log_drawn`` (n,)."""

    runs: Runs
    rows: np.ndarray
    log_drawn: np.ndarray

    def log_fem(self, pool: Pool) -> np.ndarray:
        """Log weights (n,) of FEM's posterior."""
        return pool.at.prior[self.rows] + self.runs.fem - self.log_drawn

    def log_corrected(self, pool: Pool) -> np.ndarray:
        """Log weights (n,) of the corrected map's posterior."""
        return pool.at.prior[self.rows] + pool.at.corrected[self.rows] - self.log_drawn


def figures_of(
    posterior: Posterior, predictive: Predictive, pool: Pool, tests: Tests
) -> tuple[Changes, Changes, dict[str, Figure], dict[str, Figure]]:
    """What FEM changes of the draws and of the corrected posterior; its means and sds."""
    names = posterior.model.names
    drawn = posterior.draws()
    draws = np.stack([drawn[name] for name in names], axis=1)
    here = predictive.constrain(pool.z)
    x = np.stack([here[name] for name in names], axis=1)
    corrected = pool.corrected
    by_fem, by_map = normalised(tests.log_fem(pool)), normalised(tests.log_corrected(pool))
    # Whether a point is below each quantile of the draws, and of the corrected posterior.
    edges = np.hstack([_quantiles(draws, None), _quantiles(x, corrected)]).ravel()
    below = np.repeat(x, edges.size // x.shape[1], axis=1) <= edges

    def figures(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
        share = weights / total if (total := weights.sum()) > 0.0 else weights * np.nan
        return np.concatenate([moments(x[rows], weights), share @ below[rows]])

    def change(used: np.ndarray) -> np.ndarray:
        return figures(tests.rows, by_fem * used) - figures(tests.rows, by_map * used)

    every = np.arange(len(x))
    base, base_error = jackknife(lambda used: figures(every, corrected * used), len(x))
    step, step_error = jackknife(change, len(tests.rows))
    found, error = base + step, np.hypot(base_error, step_error)
    # The draws' own share: a quantile may be a draw that comes often.
    here_too = np.repeat(draws, edges.size // x.shape[1], axis=1) <= edges
    plain = np.concatenate([moments(draws, np.ones(len(draws))), here_too.mean(axis=0)])
    p = len(names)
    mean = _named(names, found[:p], error[:p])
    sd_found = np.exp(found[p : 2 * p])
    sd = _named(names, sd_found, sd_found * error[p : 2 * p])
    of_draws = _changes(names, found - plain, error, np.exp(plain[p : 2 * p]), 0)
    of_corrected = _changes(names, step, step_error, np.exp(base[p : 2 * p]), 1)
    return of_draws, of_corrected, mean, sd


def _quantiles(x: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Quantiles (p, 3) of points (s, p) at the levels of :data:`LARGEST_MASS`."""
    levels = np.array(list(LARGEST_MASS))
    if weights is None:
        return np.quantile(x, levels, axis=0).T
    return np.quantile(x, levels, axis=0, weights=weights, method="inverted_cdf").T


def _changes(
    names: tuple[str, ...], d: np.ndarray, e: np.ndarray, sd: np.ndarray, of: int
) -> Changes:
    """Changes ``d`` of moments and masses and their errors ``e``, with means in ``sd`` (p,).

    of : quantiles of the draws, 0, or of the corrected posterior, 1.
    """
    p = len(names)
    d_mass, e_mass = (each[-6 * p :].reshape(p, 2, 3)[:, of].T for each in (d, e))
    pairs = tuple(f"{a} and {b}" for a, b in combinations(names, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        return Changes(
            _named(names, d[:p] / sd, e[:p] / sd),
            _named(names, d[p : 2 * p], e[p : 2 * p]),
            _named(pairs, d[2 * p : -6 * p], e[2 * p : -6 * p]),
            {
                level: _named(names, values, errors)
                for level, values, errors in zip(LARGEST_MASS, d_mass, e_mass, strict=True)
            },
        )


def _named(names: tuple[str, ...], values: np.ndarray, errors: np.ndarray) -> dict[str, Figure]:
    return {n: Figure(float(v), float(e)) for n, v, e in zip(names, values, errors, strict=True)}


def sampling_of(posterior: Posterior) -> Sampling:
    """The draws as draws; NumPy's maximum is NaN if any value is, unlike Python's."""
    with np.errstate(divide="ignore", invalid="ignore"):  # of draws that do not vary
        rows = posterior.summary().values()
    sizes = posterior.tree["posterior"].sizes
    return Sampling(
        float(np.max([row["r_hat"] for row in rows])),
        float(np.min([row["ess_bulk"] for row in rows])),
        float(np.min([row["ess_tail"] for row in rows])),
        posterior.divergences,
        int(sizes["chain"] * sizes["draw"]),
        vary=all(np.ptp(values) > 0.0 for values in posterior.draws().values()),
    )


def physics_of(at_draws: Runs, training: Runs, tests: Tests, pool: Pool) -> Physics:
    """How FEM fared: failures count by the posterior mass they stand for."""
    fails = int((~training.converged).sum() + (~tests.runs.converged).sum())
    share = normalised(tests.log_corrected(pool)) * len(tests.rows)
    lost = float((~at_draws.converged).sum() + share[~tests.runs.converged].sum())
    asked = [s for s in at_draws.stable if s is not None]
    finite = at_draws.smallest_J[np.isfinite(at_draws.smallest_J)]
    return Physics(
        len(training.z) + len(tests.rows),
        fails,
        lost / (len(at_draws.z) + len(tests.rows)),
        float(finite.min()) if finite.size else float("nan"),
        sum(not s for s in asked),
        len(asked),
    )


def missed_by(
    predictive: Predictive, correction: Correction, pool: Pool, tests: Tests, runs: Runs
) -> int:
    r"""Number of runs around which FEM's posterior may hide from the corrected map and the tests.

    FEM finds such a run likely (it is within the density that bounds 99 % of a Gaussian around the
    best run) and the corrected map, which these runs taught, does not: it errs there by a jump that
    no smooth process follows. That does no harm where tests come anyway: with :math:`t` of them a
    volume (:meth:`Pool.log_tested`), a mass :math:`m` of FEM's posterior :math:`\pi / Z` around the
    run has :math:`m t Z / \pi` of them in expectation. Those runs count whose mass of 0.1 a test
    would meet with less than 95 %.
    """
    there = with_guests(pool, predictive, correction, runs.z)
    guests = slice(pool.drawn, None)
    prior, corrected = there.at.prior[guests], there.at.corrected[guests]
    fem = np.where(runs.converged, prior + runs.fem, -np.inf)
    likely = fem > least_likely(fem.max(), runs.z.shape[1], _LIKELY)
    unforeseen = likely & ~(prior + corrected > fem - _MISSED)
    log_weights = tests.log_fem(pool)
    count = len(log_weights)
    with np.errstate(invalid="ignore"):  # where no test has weight, nothing is met
        log_z = logsumexp(log_weights) - np.log(count * pool.drawn)
        log_expected = np.log(_MASS) + there.log_tested(count)[guests] + log_z - fem
    return int(np.sum(unforeseen & ~(log_expected >= np.log(-np.log1p(-_MET)))))


def tail_of(pool: Pool, tests: Tests, missed: int, ends: int = 0) -> Tail:
    """Tail of FEM's weights, and how irregularly FEM and the corrected map differ."""
    log_fem, log_map = tests.log_fem(pool), tests.log_corrected(pool)
    threshold = float(min(1.0 - 1.0 / np.log10(len(log_fem)), 0.7))  # Vehtari et al. 2024, Eq. 13
    weights = normalised(log_fem)
    both = np.isfinite(log_fem) & np.isfinite(log_map)
    if not both.any():
        return Tail(np.inf, threshold, 0.0, np.inf, np.inf, effective(pool.corrected), missed, ends)
    share = normalised(np.where(both, log_map, -np.inf))[both]
    ratio = (log_fem - log_map)[both]
    spread = float(np.sqrt(share @ (ratio - share @ ratio) ** 2))
    return Tail(
        pareto_shape(log_fem[np.isfinite(log_fem)]),
        threshold,
        effective(weights),
        float(weights.max() * len(weights)),
        spread,
        effective(pool.corrected),
        missed,
        ends,
    )
