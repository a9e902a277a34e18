"""Runs that the corrected map does not foresee."""

import jax
import numpy as np
from scipy.stats import chi2, norm

from calibrate.certificate import estimates
from calibrate.certificate.correction import nothing
from calibrate.certificate.estimates import missed_by
from calibrate.certificate.pool import search
from calibrate.certificate.predictive import Predictive
from calibrate.certificate.runs import Runs
from certificate_support import NODES, exact_data, exact_posterior, linear_model
from linear_support import Step, linear_forward


def log_likelihoods(forward, data, points):
    at = forward.at(np.array(NODES))
    return norm.logpdf(data, np.asarray(jax.vmap(at)(points)), 0.1).sum(axis=(1, 2))


def test_runs_that_fem_finds_likely_and_the_map_does_not_are_counted(beam):
    """FEM is a linear map, and the cheap one is 1 mm off beyond mu = 72.5; counted by hand."""
    fem = linear_forward(beam, size=0.02)
    step = Step(fem, 72.5)
    right, wrong = linear_model(beam, forward=fem), linear_model(beam, forward=step)
    data = exact_data(right)
    points = np.array([[mu, 68.0] for mu in (68.0, 70.0, 72.0, 73.0, 74.0, 95.0)])
    exact = log_likelihoods(fem, data, points)
    share = np.log(points / 50.0) / np.log(2.0)  # the prior is uniform in it, NumPyro's z its logit
    density = exact + np.log(share * (1.0 - share)).sum(axis=1)
    likely = density > density.max() - 0.5 * chi2.ppf(0.99, 2)
    by_hand = np.sum(likely & (log_likelihoods(step, data, points) < exact - 3.0))
    seen, missing = (Predictive(m, m.check_data(data)) for m in (right, wrong))
    z = seen.unconstrain({"mu": points[:, 0], "lam": points[:, 1]})
    runs = Runs(z, exact, np.zeros((6, 9)), np.ones(6), (None,) * 6, (None,) * 6)
    rng = np.random.default_rng(0)
    # As of the wrong map: none beyond its step.
    draws = exact_posterior(right, data, count=400, keep=lambda x: x[:, 0] < 72.5).draws()

    def counted(predictive, tests):
        pool = search(predictive, nothing(1, 2, 9), predictive.unconstrain(draws), (), rng)
        chances = np.exp(pool.log_chances)
        rows = rng.choice(pool.drawn, size=tests, p=chances / chances.sum())
        at = predictive.constrain(pool.z[rows])
        found = log_likelihoods(fem, data, np.stack([at["mu"], at["lam"]], axis=1))
        tested = Runs(pool.z[rows], found, np.zeros((tests, 9)), np.ones(tests), (), ())
        drawn = (pool.log_mixture + pool.log_chances)[rows]
        tests = estimates.Tests(tested, rows, drawn)
        return missed_by(predictive, nothing(1, 2, 9), pool, tests, runs)

    assert counted(missing, 20) == by_hand > 0  # too few tests to meet what is hidden
    assert counted(missing, 4000) == 0
    assert counted(seen, 20) == 0
