r"""The evidence of a certificate, estimated from the pool and the FEM runs that test it.

The Monte Carlo error of any figure is the delete-a-group jackknife's,

.. math:: e^2 = \frac{G - 1}{G} \sum_g (\hat\theta_{(g)} - \hat\theta)^2

with every G-th point in a group (Owen 2013, Section 2.7; Wolter 2007). It ignores a tail that no
point has reached; Pareto :math:`\hat k` watches that.

A posterior predictive check tests whether the model could have made the data. For draws of
FEM's posterior and data :math:`\tilde y` simulated from each, two discrepancies between data and
prediction (Gelman, Meng and Stern 1996),

.. math:: T_1(y, \theta) = -\log p(y \mid \theta), \qquad
    T_2(y, \theta) = \max_j |y_j - \mathrm{E} y_j| / \mathrm{sd}\, y_j

have p-values :math:`P(T(\tilde y, \theta) \ge T(y, \theta))`. With Gaussian noise :math:`T_1` is
half of chi squared. Near 0 the data lies further from every prediction than the noise allows
(outliers, a registration error, a wrong law, a noise sd too small), and :math:`T_1` near 1 means
closer (an sd too large). The check cannot see an error that parameters can absorb, a wrong sd of a
single number, and a wrong sd where the sd is inferred.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import logsumexp

from calibrate.certificate.evidence import LARGEST_MASS, Changes, Evidence, Figure, Physics, Tail
from calibrate.certificate.runs import FEMRuns, least_likely
from calibrate.importance.proposals import key_from
from calibrate.importance.weights import effective, normalised, pareto_shape
from calibrate.measurements.labels import datum_names
from calibrate.posterior import Posterior
from calibrate.posterior.diagnosis import Misfit, Sampling
from calibrate.statistical_model.errors import in_noise_sd
from calibrate.statistical_model.pool import Pool
from calibrate.statistical_model.predictive import Predictive
from emulator.surrogates.correction import Correction

GROUPS = 25
_DRAWS = 1000  # draws of the posterior predictive check
_LIKELY = 0.99  # mass of the Gaussian at the best run in which FEM finds a run likely
_MISSED = 3.0  # log likelihood: the corrected map finds a run 20 times less likely than FEM
# A part of FEM's posterior with this mass is met by a test with this probability.
_MASS, _MET = 0.1, 0.95


@dataclass(frozen=True, eq=False)
class Tests:
    """FEM at points of a pool.

    rows : the points' rows (n,) in the pool.
    log_drawn : the log density (n,) that the points were drawn from.
    """

    pool: Pool
    runs: FEMRuns
    rows: np.ndarray
    log_drawn: np.ndarray

    @property
    def log_fem(self) -> np.ndarray:
        """Log weights (n,) of FEM's posterior."""
        return self.pool.at.prior[self.rows] + self.runs.fem - self.log_drawn

    @property
    def log_corrected(self) -> np.ndarray:
        """Log weights (n,) of the corrected map's posterior."""
        at = self.pool.at
        return at.prior[self.rows] + at.corrected[self.rows] - self.log_drawn


def moments(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return means (p,), log sds (p,) and correlations (p (p - 1) / 2,) as one vector.

    Points ``x`` (s, p) with ``weights`` (s,) of any sum; NaN where all weights are zero.
    """
    total = weights.sum()
    if not total > 0.0:
        p = x.shape[1]
        return np.full(2 * p + p * (p - 1) // 2, np.nan)
    used = weights > 0.0  # far away a scale may be infinite, which no weight of zero takes back
    x, share = x[used], weights[used] / total
    mean = share @ x
    centred = x - mean
    covariance = (share[:, None] * centred).T @ centred
    sd = np.sqrt(np.diag(covariance))
    upper = np.triu_indices(len(sd), 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.concatenate([mean, np.log(sd), covariance[upper] / (sd[upper[0]] * sd[upper[1]])])


def jackknife(
    figures: Callable[[np.ndarray], np.ndarray], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``figures`` of all of ``count`` points, and their errors.

    figures : a function of the mask (count,) of the points to use.
    """
    groups = min(GROUPS, count)
    member = np.arange(count) % groups
    value = figures(np.ones(count, dtype=bool))
    left_out = np.array([figures(member != g) for g in range(groups)])
    return value, np.sqrt((groups - 1) / groups * ((left_out - value) ** 2).sum(axis=0))


def evidence_of(
    posterior: Posterior,
    at_draws: FEMRuns,
    training: FEMRuns,
    tests: Tests,
    modes: int,
    rng: np.random.Generator,
) -> Evidence:
    """Return all figures but those of a finer mesh.

    Parameters
    ----------
    at_draws : FEM at draws of the posterior, a part of ``training``.
    training : the runs that the correction of the pool was fitted to.
    modes : the number of further modes of FEM that descents have found.
    """
    pool, figures = tests.pool, figures_of(posterior, tests)
    missed = missed_by(tests, FEMRuns.joined([training, tests.runs]))
    means, valid = pool.predictive.means(at_draws.z)
    errors = (means - at_draws.means)[valid & at_draws.converged]
    z = pool.z[pool.resampled(_DRAWS, rng)]
    return Evidence(
        *figures,
        sampling_of(posterior),
        physics_of(at_draws, training, tests),
        tail_of(tests, missed, modes),
        misfits(pool.predictive, pool.correction, z, key_from(rng)),
        in_noise_sd(posterior.model, errors, posterior.draws()),
        box=tuple(posterior.box_ends()),
        noise=tuple(posterior.inferred_noise()),
        forward=posterior.model.full.kind,
    )


def figures_of(
    posterior: Posterior, tests: Tests
) -> tuple[Changes, Changes, dict[str, Figure], dict[str, Figure]]:
    """Return FEM's changes of the draws and of the corrected posterior, and its means and sds.

    Changes are of logarithms where a parameter's scale is logarithmic: the sd of a parameter that
    is known to a factor of ten is decided by a few draws.
    """
    pool, names, p = tests.pool, posterior.model.names, len(posterior.model.names)
    on_scales = pool.predictive.on_scales
    values = pool.predictive.columns(pool.z)
    draws = on_scales(np.stack(list(posterior.draws().values()), axis=1))
    x, corrected = on_scales(values), pool.corrected
    by_fem, by_map = normalised(tests.log_fem), normalised(tests.log_corrected)
    # Masses are below quantiles of the draws, and of the corrected posterior.
    levels = list(LARGEST_MASS)
    of_map = np.quantile(x, levels, axis=0, weights=corrected, method="inverted_cdf")
    edges = np.vstack([np.quantile(draws, levels, axis=0), of_map]).T

    def below(points: np.ndarray) -> np.ndarray:
        return np.repeat(points, edges.shape[1], axis=1) <= edges.ravel()

    x_below = below(x)

    def figures(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
        share = weights / total if (total := weights.sum()) > 0.0 else weights * np.nan
        plain = moments(values[rows], weights)[: 2 * p]
        return np.concatenate([moments(x[rows], weights), share @ x_below[rows], plain])

    def change(used: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):  # one run has all the weight: the log sd is -inf
            return figures(tests.rows, by_fem * used) - figures(tests.rows, by_map * used)

    every = np.arange(len(x))
    base, base_error = jackknife(lambda used: figures(every, corrected * used), len(x))
    step, step_error = jackknife(change, len(tests.rows))
    fem, error = base + step, np.hypot(base_error, step_error)
    # The draws' own mass below their quantiles: a quantile may be a draw that comes often.
    before = np.concatenate([moments(draws, np.ones(len(draws))), below(draws).mean(axis=0)])
    count, sd = len(before), np.exp(fem[-p:])
    return (
        _changes(names, fem[:count] - before, error[:count], before, edges=0),
        _changes(names, step[:count], step_error[:count], base[:count], edges=1),
        dict(zip(names, as_figures(fem[count : count + p], error[count : count + p]), strict=True)),
        dict(zip(names, as_figures(sd, sd * error[-p:]), strict=True)),
    )


def _changes(
    names: tuple[str, ...], change: np.ndarray, error: np.ndarray, before: np.ndarray, *, edges: int
) -> Changes:
    """Return changes with their errors, means in the sd of the figures ``before``.

    edges : masses are below the quantiles of the draws, 0, or of the corrected posterior, 1.
    """
    p, levels = len(names), len(LARGEST_MASS)
    pairs = [f"{a} and {b}" for a, b in combinations(names, 2)]
    unit = np.concatenate([np.exp(before[p : 2 * p]), np.ones(len(change) - p)])
    with np.errstate(divide="ignore", invalid="ignore"):
        figures = as_figures(change / unit, error / unit)
    masses = figures[2 * p + len(pairs) :]  # of each name below both edges, level by level
    return Changes(
        dict(zip(names, figures, strict=False)),
        dict(zip(names, figures[p:], strict=False)),
        dict(zip(pairs, figures[2 * p :], strict=False)),
        {
            level: dict(zip(names, masses[edges * levels + k :: 2 * levels], strict=True))
            for k, level in enumerate(LARGEST_MASS)
        },
    )


def as_figures(values: np.ndarray, errors: np.ndarray) -> list[Figure]:
    """Return each value with its error."""
    return [Figure(float(v), float(e)) for v, e in zip(values, errors, strict=True)]


def sampling_of(posterior: Posterior) -> Sampling:
    """Return the quality of the draws; NumPy's maximum is NaN if any value is, unlike Python's."""
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


def physics_of(at_draws: FEMRuns, training: FEMRuns, tests: Tests) -> Physics:
    """Return the outcome of the FEM runs; failures count by the posterior mass they stand for."""
    failed = int((~training.converged).sum() + (~tests.runs.converged).sum())
    share = normalised(tests.log_corrected) * len(tests.rows)
    failed_mass = float((~at_draws.converged).sum() + share[~tests.runs.converged].sum())
    examined = [s for s in at_draws.stable if s is not None]
    finite = at_draws.smallest_J[np.isfinite(at_draws.smallest_J)]
    return Physics(
        len(training.z) + len(tests.rows),
        failed,
        failed_mass / (len(at_draws.z) + len(tests.rows)),
        float(finite.min()) if finite.size else float("nan"),
        sum(not s for s in examined),
        len(examined),
    )


def missed_by(tests: Tests, runs: FEMRuns) -> int:
    r"""Return the number of runs around which FEM may have a mode that no test would meet.

    Such a run is likely by FEM (within the density that bounds 99 % of a Gaussian at the best run)
    and not by the corrected map, although the map is corrected by these runs: the map errs there by
    a jump that no smooth process follows. That does no harm where tests come anyway: with a density
    of tests :math:`t` (:meth:`Pool.log_tested`), a mass :math:`m` of FEM's posterior
    :math:`\pi / Z` around the run gets :math:`m t Z / \pi` tests in expectation. Those runs count
    at which a mass of 0.1 would be met with less than 95 % probability.
    """
    pool = tests.pool.with_points(runs.z)
    added = slice(pool.drawn, None)
    prior, corrected = pool.at.prior[added], pool.at.corrected[added]
    fem = np.where(runs.converged, prior + runs.fem, -np.inf)
    likely = fem > least_likely(fem.max(), runs.z.shape[1], _LIKELY)
    unforeseen = likely & ~(prior + corrected > fem - _MISSED)
    log_weights = tests.log_fem
    count = len(log_weights)
    with np.errstate(invalid="ignore"):  # where no test has weight, nothing is met
        log_z = logsumexp(log_weights) - np.log(count * pool.drawn)
        log_expected = np.log(_MASS) + pool.log_tested(count)[added] + log_z - fem
    return int(np.sum(unforeseen & ~(log_expected >= np.log(-np.log1p(-_MET)))))


def tail_of(tests: Tests, missed: int, modes: int = 0) -> Tail:
    """Return the tail of FEM's weights, and the spread of their log ratios to the map's."""
    log_fem, log_map = tests.log_fem, tests.log_corrected
    threshold = float(min(1.0 - 1.0 / np.log10(len(log_fem)), 0.7))  # Vehtari et al. 2024, Eq. 13
    points = effective(tests.pool.corrected)
    both = np.isfinite(log_fem) & np.isfinite(log_map)
    if not both.any():
        return Tail(np.inf, threshold, 0.0, np.inf, np.inf, points, missed, modes)
    weights = normalised(log_fem)
    share = normalised(np.where(both, log_map, -np.inf))[both]
    ratio = log_fem[both] - log_map[both]
    return Tail(
        pareto_shape(log_fem[np.isfinite(log_fem)]),
        threshold,
        effective(weights),
        float(weights.max() * len(weights)),
        float(np.sqrt(share @ (ratio - share @ ratio) ** 2)),
        points,
        missed,
        modes,
    )


def misfits(
    predictive: Predictive, correction: Correction, z: np.ndarray, rng_key: jax.Array
) -> dict[str, Misfit]:
    """Return the misfit of each observation by its name, from draws z (s, p) of FEM's posterior."""
    model, data = predictive.model, predictive.data
    draws = {name: jnp.asarray(values) for name, values in predictive.constrain(z).items()}
    flat = jnp.asarray(predictive.corrected_means(z, correction))

    def discrepancies(flat: jax.Array, draw: dict[str, jax.Array], key: jax.Array) -> Any:
        means = model.observe.unravel(flat)
        parts = model.distributions(draw, means)
        key, error_key = jax.random.split(key)
        errors = jax.tree.map(jnp.subtract, model.means_with_errors(error_key, draw, means), means)
        keys = jax.random.split(key, len(parts))
        by_name = {}
        for (name, distribution), key in zip(parts.items(), keys, strict=True):
            y, mean, simulated = data[name], means[name], distribution.sample(key) + errors[name]
            unlikelier = distribution.log_prob(simulated) <= distribution.log_prob(y)
            by_name[name] = unlikelier, jnp.abs(simulated - mean), jnp.abs(y - mean)
        return by_name

    by_name = jax.jit(jax.vmap(discrepancies))(flat, draws, jax.random.split(rng_key, len(z)))
    misfit = {}
    for name, (unlikelier, *distances) in by_name.items():
        simulated, distance = (np.asarray(x).reshape(len(z), -1) for x in distances)
        misfit[name] = Misfit.of(datum_names(model.observe, name), unlikelier, simulated, distance)
    return misfit
