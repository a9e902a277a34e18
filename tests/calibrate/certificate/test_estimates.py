"""Figures of a certificate: moments and their errors, misfit, runs the map does not foresee."""

import jax
import numpy as np
import pytest
from scipy.stats import chi2, norm

import calibrate as cal
from calibrate.certificate import estimates
from calibrate.certificate.estimates import jackknife, misfits, missed_by, moments
from calibrate.certificate.runs import FEMRuns
from calibrate.posterior.diagnosis import Misfit
from calibrate.statistical_model.pool import Pool
from calibrate.statistical_model.predictive import Predictive
from certificate_support import (
    NODES,
    exact_data,
    exact_posterior,
    grid_of,
    linear_model,
    quadrature,
)
from emulator.surrogates.correction import no_correction
from linear_support import Step, linear_forward

MANY = list(range(5, 45))


def test_moments_of_weighted_points():
    """Weights 1, 2, 1 are the points 0, 1, 1, 2."""
    x, weights = np.array([[0.0, 1.0], [1.0, 0.0], [2.0, 5.0]]), np.array([1.0, 2.0, 1.0])
    repeated = x[[0, 1, 1, 2]]
    expected = [
        *repeated.mean(axis=0),
        *np.log(repeated.std(axis=0)),
        np.corrcoef(repeated, rowvar=False)[0, 1],
    ]
    np.testing.assert_allclose(moments(x, weights), expected, rtol=1e-14)
    np.testing.assert_allclose(moments(x, 7.0 * weights), expected, rtol=1e-14)


def test_points_without_weight_are_not_read():
    x, weights = np.array([[1.0], [3.0], [np.inf]]), np.array([1.0, 1.0, 0.0])
    np.testing.assert_allclose(moments(x, weights), [2.0, 0.0], atol=1e-12)


def test_changes_are_of_logarithms_of_theta_and_of_noise_itself(beam):
    model = linear_model(beam)
    assert model.on_log_scale.all()
    predictive = Predictive(model, exact_data(model))
    columns = np.array([[60.0, 70.0], [90.0, 55.0]])
    np.testing.assert_allclose(predictive.on_scales(columns), np.log(columns))
    inferred = cal.model(
        model.full, cal.nodal_displacements(beam, NODES), cal.GaussianNoise(sd_scale=0.2)
    )
    with_noise = np.column_stack([columns, [0.1, 0.3]])
    on_scales = Predictive(inferred, exact_data(model)).on_scales(with_noise)
    np.testing.assert_allclose(on_scales, np.column_stack([np.log(columns), [0.1, 0.3]]))


def test_nothing_has_no_moments():
    assert np.isnan(moments(np.ones((4, 2)), np.zeros(4))).all()


def test_errors_of_a_mean_and_an_sd():
    """sd / sqrt(n), and for a Gaussian's log sd 1 / sqrt(2 n), over repetitions."""
    rng = np.random.default_rng(0)
    found, errors = [], []
    for _ in range(200):
        x = rng.normal(size=(100, 1))
        value, error = jackknife(lambda used, x=x: moments(x, used.astype(float)), 100)
        found.append(value)
        errors.append(error)
    actual = np.std(found, axis=0)
    np.testing.assert_allclose(actual, [0.1, 0.0707], rtol=0.2)
    # A variance of 24 degrees of freedom is uncertain by 14 %, its root by half of that.
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(errors), axis=0)), actual, rtol=0.15)


def test_a_figure_of_equal_points_has_no_error():
    _, error = jackknife(lambda used: np.ones(3)[used[:3]].mean(keepdims=True), 50)
    assert error == pytest.approx(0.0)


def misfit_of(beam, change=None, sd=0.1, seed=0):
    """Misfit of data with noise of 0.1 mm, ``change`` made to it, under a model of ``sd``."""
    model = linear_model(beam, sd, nodes=MANY)
    data = exact_data(model, seed)
    if change is not None:
        change(data)
    points, rng = grid_of(), np.random.default_rng(seed)
    rows = rng.choice(len(points), size=400, p=quadrature(model.full, data, sd, points, MANY))
    predictive = Predictive(model, {"displacement": data})
    z = predictive.unconstrain({"mu": points[rows, 0], "lam": points[rows, 1]})
    return misfits(predictive, no_correction(1, 2, 120), z, jax.random.key(seed))["displacement"]


def test_data_of_the_model_fits(beam):
    values = [misfit_of(beam, seed=seed).p for seed in (0, 3)]
    assert 0.05 < min(values) < max(values) < 0.98


def test_the_p_value_is_that_of_chi_squared(beam):
    """At one theta and a known sd, T_1 of simulated data is chi squared, here with 9 degrees."""
    model = linear_model(beam)
    data = exact_data(model, 3)
    predictive = Predictive(model, {"displacement": data})
    z = np.repeat(
        predictive.unconstrain({"mu": np.array([72.0]), "lam": np.array([68.0])}), 4000, 0
    )
    p = misfits(predictive, no_correction(1, 2, 9), z, jax.random.key(0))["displacement"].p
    residual = data - np.asarray(model.forward(np.array([72.0, 68.0])))
    exact = chi2.sf((residual**2).sum() / 0.1**2, 9)
    assert abs(p - exact) < 4 * np.sqrt(exact * (1 - exact) / 4000)


def test_an_outlier_is_found_and_named(beam):
    def spoil(data):
        data[1, 2] += 1.0

    result = misfit_of(beam, spoil)
    assert result.p < 0.005
    assert next(iter(result.outlying)).startswith("displacement z of node ")


def test_a_wrong_noise_sd_is_found_on_either_side(beam):
    assert misfit_of(beam, sd=0.07).p < 0.005
    assert misfit_of(beam, sd=0.15).p > 0.995


def test_an_inferred_noise_and_a_single_number(beam):
    """Nothing to compare a single number's noise with: it always fits."""
    forward = linear_forward(beam, size=0.02)
    observe = cal.nodal_displacements(beam, [3])
    model = cal.model(forward, observe, cal.GaussianNoise(sd_scale=1.0))
    data = np.asarray(forward.at(observe.nodes)(np.array([72.0, 68.0])))
    predictive = Predictive(model, {"displacement": data})
    draws = {"mu": np.full(300, 72.0), "lam": np.full(300, 68.0), "noise_sd": np.full(300, 0.2)}
    result = misfits(
        predictive, no_correction(1, 2, 3), predictive.unconstrain(draws), jax.random.key(0)
    )
    assert result["displacement"].p == pytest.approx(1.0)
    assert not result["displacement"].outlying


def test_a_single_number_is_compared_too():
    rng = np.random.default_rng(0)
    simulated = np.abs(rng.normal(size=(500, 1)))
    near = Misfit.of(["volume"], np.ones(500), simulated, np.full((500, 1), 0.5))
    assert near.p_worst > 0.5
    far = Misfit.of(["volume"], np.zeros(500), simulated, np.full((500, 1), 6.0))
    assert list(far.outlying) == ["volume"]
    assert far.p_worst == 0.0


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
    runs = FEMRuns(z, exact, np.zeros((6, 9)), np.ones(6), (None,) * 6, (None,) * 6)
    rng = np.random.default_rng(0)
    # As of the wrong map: none beyond its step.
    draws = exact_posterior(right, data, count=400, keep=lambda x: x[:, 0] < 72.5).draws()

    def counted(predictive, tests):
        pool = Pool.search(
            predictive, no_correction(1, 2, 9), predictive.unconstrain(draws), (), rng
        )
        rows, drawn = pool.tests(tests, rng)
        at = predictive.constrain(pool.z[rows])
        found = log_likelihoods(fem, data, np.stack([at["mu"], at["lam"]], axis=1))
        tested = FEMRuns(pool.z[rows], found, np.zeros((tests, 9)), np.ones(tests), (), ())
        return missed_by(estimates.Tests(pool, tested, rows, drawn), runs)

    assert counted(missing, 20) == by_hand > 0  # too few tests to meet what is hidden
    assert counted(missing, 4000) == 0
    assert counted(seen, 20) == 0


@pytest.mark.parametrize("levels", [1, 4])
def test_masses_are_below_as_many_quantiles_as_are_limited(beam, levels, monkeypatch):
    limits = dict.fromkeys(np.linspace(0.1, 0.9, levels).tolist(), 0.1)
    monkeypatch.setattr(estimates, "LARGEST_MASS", limits)
    model = linear_model(beam)
    posterior = exact_posterior(model, exact_data(model), count=400)
    predictive, rng = Predictive(model, posterior.data), np.random.default_rng(0)
    z = predictive.unconstrain(posterior.draws())
    pool = Pool.search(predictive, no_correction(1, 2, 9), z, (), rng)
    rows, drawn = pool.tests(50, rng)
    runs = FEMRuns(pool.z[rows], pool.at.corrected[rows], np.zeros((50, 9)), np.ones(50), (), ())
    tests = estimates.Tests(pool, runs, rows, drawn)
    of_draws, of_corrected, mean, _ = estimates.figures_of(posterior, tests)
    assert list(of_draws.mass) == list(of_corrected.mass) == list(limits)
    assert max(abs(f.value) for f in of_corrected.mass[next(iter(limits))].values()) < 1e-12
    assert list(of_draws.correlation) == ["lam and mu"] or list(of_draws.correlation) == [
        "mu and lam"
    ]
    assert abs(mean["mu"].value - posterior.draws()["mu"].mean()) < 1.0
