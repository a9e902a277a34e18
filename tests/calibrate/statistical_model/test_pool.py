"""Pools of cheap points, and the kernels they are drawn from."""

import jax
import numpy as np
import pytest

from calibrate.certificate.estimates import jackknife, moments
from calibrate.importance import transport
from calibrate.importance.proposals import Kernels, tempered
from calibrate.importance.weights import effective, normalised
from calibrate.samplers import density_of
from calibrate.statistical_model.pool import Pool
from calibrate.statistical_model.predictive import Predictive
from certificate_support import exact_data, exact_posterior, grid_of, linear_model, quadrature
from emulator.surrogates.correction import no_correction


@pytest.fixture(scope="module")
def case(beam):
    model = linear_model(beam)
    data = exact_data(model)
    return exact_posterior(model, data), data


@pytest.fixture(scope="module")
def predictive(case):
    return Predictive(case[0].model, case[0].data)


def test_densities_are_the_samplers(case, predictive):
    """Prior and likelihood, each by itself, add up to the density that NUTS sees."""
    z = predictive.prior_draws(jax.random.key(0), 7)
    at = predictive.evaluate(z, no_correction(1, 2, 9))
    density = density_of(case[0].model)
    seen = [float(density.log_density(x, case[0].data)) for x in z]
    np.testing.assert_allclose(at.prior + at.cheap, seen, rtol=1e-12)
    np.testing.assert_array_equal(at.cheap, at.corrected)


def test_coordinates_go_there_and_back(case, predictive):
    draws = {name: values[:300] for name, values in case[0].draws().items()}
    back = predictive.constrain(predictive.unconstrain(draws))
    for name, values in draws.items():
        np.testing.assert_allclose(back[name], values, rtol=1e-12)
    bound = predictive.unconstrain({"mu": np.array([100.0]), "lam": np.array([50.0])})
    assert np.isfinite(bound).all()


def test_the_priors_draws_are_log_uniform(predictive):
    mu = predictive.constrain(predictive.prior_draws(jax.random.key(1), 2000))["mu"]
    below = np.log(70.0 / 50.0) / np.log(2.0)
    assert abs(np.mean(mu < 70.0) - below) < 4 * np.sqrt(below * (1 - below) / 2000)


def mean_and_sd(weights, values):
    mean = weights @ values
    return mean, np.sqrt(weights @ (values - mean) ** 2)


def test_the_pool_is_the_posterior_wherever_the_draws_are(case, predictive):
    """Even from draws of one end of it."""
    posterior, data = case
    exact = mean_and_sd(quadrature(posterior.model.full, data), grid_of()[:, 0])
    for values in (
        posterior.draws(),
        {"mu": 52.0 + np.arange(50.0) / 50, "lam": 90 + np.zeros(50)},
    ):
        z = predictive.unconstrain(values)
        pool = Pool.search(predictive, no_correction(1, 2, 9), z, (), np.random.default_rng(0))
        assert effective(pool.corrected) > 500.0
        mean, sd = mean_and_sd(pool.corrected, predictive.constrain(pool.z)["mu"])
        assert abs(mean - exact[0]) < 0.15 * exact[1]
        assert sd == pytest.approx(exact[1], rel=0.1)


def test_more_points_are_drawn_where_the_pool_alone_leaves_an_sd_uncertain(
    case, predictive, monkeypatch
):
    """The error of the delta method is the jackknife's; it falls as points are added."""
    z, rng = predictive.unconstrain(case[0].draws()), np.random.default_rng(2)
    pool = Pool.search(predictive, no_correction(1, 2, 9), z, (), rng)
    few = pool.redrawn(rng)
    x = predictive.on_scales(predictive.columns(few.z))
    _, error = jackknife(lambda used: moments(x, few.corrected * used)[2:4], len(x))
    assert few.sd_error == pytest.approx(error.max(), rel=0.3)
    assert few.drawn == len(few.z) == pool.drawn
    monkeypatch.setattr("calibrate.statistical_model.pool._LARGEST_SD_ERROR", few.sd_error / 1.9)
    more = pool.redrawn(rng)
    assert more.drawn == len(more.z) == 4 * pool.drawn
    assert more.sd_error == pytest.approx(0.5 * few.sd_error, rel=0.2)
    few_mean, few_sd = mean_and_sd(few.corrected, few.z[:, 0])
    more_mean, more_sd = mean_and_sd(more.corrected, more.z[:, 0])
    assert abs(more_mean - few_mean) < 0.2 * few_sd
    assert more_sd == pytest.approx(few_sd, rel=0.15)
    monkeypatch.setattr("calibrate.statistical_model.pool._MOST_NUMBERS", 2 * 9 * pool.drawn)
    assert pool.redrawn(rng).drawn == 2 * pool.drawn


def test_tempering_leaves_as_many_as_asked():
    log = np.append(-(np.arange(100.0) ** 2), -np.inf)
    assert effective(normalised(log)) < 3.0
    flat = tempered(log, 40.0)
    assert effective(flat) == pytest.approx(40.0, rel=1e-3)
    assert flat[-1] == 0.0
    even = np.zeros(50)
    np.testing.assert_allclose(tempered(even, 40.0), 0.02)


def test_no_density_has_no_weights():
    weights = normalised(np.full(4, -np.inf))
    np.testing.assert_array_equal(weights, 0.0)
    assert effective(weights) == 0.0


@pytest.mark.slow
def test_tests_are_where_they_are_said_to_be(case, predictive):
    """Distinct points that tests take in a cell, counted in pool after pool."""
    rng = np.random.default_rng(5)
    draws = predictive.unconstrain(case[0].draws())
    mean, sd = draws.mean(axis=0), draws.std(axis=0)
    pool = Pool.search(predictive, no_correction(1, 2, 9), draws[:500], (), rng)
    pools = [pool.redrawn(rng) for _ in range(40)]
    side = (np.arange(12) + 0.5) / 6.0 - 1.0
    square = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    # Where the draws are, at their edge, and where only the prior is: there every point is taken.
    for centre, width, tests in (
        (mean, 0.5 * sd, 80),
        (mean + 1.5 * sd, 0.5 * sd, 400),
        (np.array([1.5, 2.0]), np.array([1.0, 1.0]), 30_000),
    ):
        found, said = [], []
        for each in pools:
            more = each.with_points(centre + square * width)
            np.testing.assert_array_equal(more.log_chances[: each.drawn], each.log_chances)
            density = np.exp(more.log_tested(tests)[each.drawn :])
            said.append(density.mean() * np.prod(2.0 * width))
            chances = np.exp(each.log_chances)
            for _ in range(10):
                rows = np.unique(rng.choice(each.drawn, size=tests, p=chances / chances.sum()))
                found.append(np.sum((np.abs(each.z[rows] - centre) < width).all(axis=1)))
        assert np.mean(found) > 1.0
        assert np.mean(found) == pytest.approx(np.mean(said), rel=0.1)


@pytest.fixture(scope="module")
def bent():
    """Draws on a bent ridge."""
    x = np.random.default_rng(0).normal(size=(600, 2))
    return np.stack([x[:, 0], 0.1 * x[:, 1] + np.tanh(x[:, 0]) ** 2], axis=1)


def test_straightening_inverts_the_samplers_map(bent):
    map_ = transport.fit(bent)
    zeta = transport.straighten(map_, bent)
    back = jax.vmap(lambda one: transport.apply(map_, one))(zeta)
    np.testing.assert_allclose(back, bent, atol=1e-12)
    np.testing.assert_allclose(transport.bend(map_, zeta), bent, atol=1e-12)
    assert np.std(zeta[:, 1]) < 0.6 * np.std(bent[:, 1])


def test_the_density_integrates_to_one_and_is_the_draws(bent):
    kernels = Kernels.around(bent, (0.3, 1.0), 5.0, np.random.default_rng(1))
    axis = np.linspace(-8.0, 8.0, 321)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    density = np.exp(kernels.log_density(grid)) * 0.05**2
    assert density.sum() == pytest.approx(1.0, abs=0.01)
    z = kernels.sample(np.random.default_rng(2), 4000)
    left = grid[:, 0] < -0.5
    error = np.sqrt(0.25 / 4000)
    assert abs(np.mean(z[:, 0] < -0.5) - density[left].sum()) < 4 * error


def test_a_coordinate_that_does_not_vary_has_a_density(bent):
    still = bent * np.array([1.0, 0.0])
    kernels = Kernels.around(still, (0.5,), 5.0, np.random.default_rng(1))
    assert np.isfinite(kernels.log_density(still)).all()
