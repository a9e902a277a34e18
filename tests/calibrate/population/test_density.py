"""The density of a population, term by term, its members integrated out, and weights by draws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

import calibrate as cal
from calibrate.population import population_model
from calibrate.population.density import Alone, density_of_population, log_likelihoods
from calibrate.population.mixtures import Mixtures, likelihood_of, stacked
from calibrate.population.model import PopulationDraws
from linear_support import linear_forward

LOW, HIGH = np.log(50.0), np.log(100.0)


@pytest.fixture(scope="module")
def model(beam):
    """Two members of two parameters."""
    forward, observe = linear_forward(beam), cal.nodal_displacements(beam, [3, 11, 20])
    member = cal.model(forward, observe, cal.GaussianNoise(sd=0.1), check_scale=False)
    return population_model({"first": member, "second": member}, eta=3.0)


@pytest.fixture(scope="module")
def mixtures():
    """One part of data, and two parts of which one says nothing of the second parameter."""
    one = Mixtures(
        np.array([4.2, 4.3]), np.array([0.3]), np.array([[8.0, -20.0]]),
        np.array([[[400.0, 90.0], [90.0, 50.0]]]),
    )  # fmt: skip
    two = Mixtures(
        np.array([4.3, 4.2]), np.array([-1.0, 0.5]), np.array([[30.0, 0.0], [-40.0, 60.0]]),
        np.array([[[900.0, 0.0], [0.0, 0.0]], [[300.0, -50.0], [-50.0, 600.0]]]),
    )  # fmt: skip
    return stacked([one, two])


def population(median=(70.0, 75.0), sd=(0.05, 0.08), r=-0.6):
    factor = np.linalg.cholesky(np.array([[1.0, r], [r, 1.0]]))
    return PopulationDraws(*map(jnp.array, (median, sd, factor)))


def test_the_integral_over_a_member_is_that_of_a_grid(model, mixtures):
    """Of the sum of parts times the population's normal, by quadrature."""
    some = population()
    found = np.asarray(log_likelihoods(model, some, mixtures))
    m, M = np.log(np.asarray(some.median)), np.asarray(some.sd)[:, None] * np.asarray(some.factor)
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    z = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    log_weight = np.log(np.outer(weights, weights).ravel() / (2.0 * np.pi))
    x = m + z @ M.T
    a, b = ((end - m) / np.asarray(some.sd) for end in (LOW, HIGH))
    mass = np.log(stats.norm.cdf(b) - stats.norm.cdf(a)).sum()
    for i in range(2):
        t = x - mixtures.centre[i]
        parts = mixtures.constant[i][:, None] + mixtures.slope[i] @ t.T
        parts = parts - 0.5 * np.einsum("sk,jkl,sl->js", t, mixtures.precision[i], t)
        expected = logsumexp(log_weight + logsumexp(parts, axis=0)) - mass
        assert found[i] == pytest.approx(expected, rel=1e-9)


def test_its_prior_is_the_one_documented(model, mixtures):
    """Up to a constant; positive and bounded unknowns have the Jacobian of their logarithm, ..."""
    density = density_of_population(model)
    different = []
    for z in jax.random.normal(jax.random.key(3), (4, density.dimension)):
        some = jax.tree.map(lambda values: values[0], density.constrain(z[None]))
        s, theta = np.asarray(some.sd), np.asarray(some.median)
        # log-uniform, and theta in (low, high) by the sigmoid: d theta/dz = (t - l)(h - t) / (h - l)
        expected = np.log((theta - 50.0) * (100.0 - theta) / theta).sum()
        scale = 0.5 * (HIGH - LOW) / np.sqrt(12.0)
        expected += stats.halfnorm.logpdf(s, scale=scale).sum() + np.log(s).sum()
        r = float((some.factor @ some.factor.T)[0, 1])
        expected += 2.0 * np.log1p(-(r**2)) + np.log1p(-(r**2))  # det(R)^(eta - 1), dr/dz
        expected += np.asarray(log_likelihoods(model, some, mixtures)).sum()
        different.append(float(density.log_density(z, mixtures)) - expected)
    # The sd of the prior is that of draws, so that the scale is known to some per cent.
    np.testing.assert_allclose(different, different[0], atol=0.1)


@pytest.mark.parametrize("median", [(70.0, 95.0), (52.0, 99.0)])
def test_a_member_has_the_density_documented(model, median):
    """Of x by a change of variables from z, and as the cut normals of a Gaussian copula."""
    some = population(median, (0.15, 0.1))
    m, sd, factor = np.log(np.array(median)), np.array([0.15, 0.1]), np.asarray(some.factor)
    z = np.array([0.4, -1.1])

    def x(z):
        values = model.shared_values(some, z)
        return jnp.log(jnp.stack([values["mu"], values["lam"]]))

    value, slopes = np.asarray(x(jnp.array(z))), np.asarray(jax.jacfwd(x)(jnp.array(z)))
    by_change = stats.norm.logpdf(z).sum() - np.linalg.slogdet(slopes)[1]
    a, b = (LOW - m) / sd, (HIGH - m) / sd
    q = stats.norm.ppf(stats.truncnorm.cdf(value, a, b, m, sd))
    copula = stats.multivariate_normal.logpdf(q, np.zeros(2), factor @ factor.T)
    mass = stats.norm.cdf(b) - stats.norm.cdf(a)
    documented = copula - stats.norm.logpdf(q).sum()
    documented += (stats.norm.logpdf(value, m, sd) - np.log(mass)).sum()
    np.testing.assert_allclose(by_change, documented, rtol=1e-9)
    found = float(model.log_density(jnp.asarray(value), some)) - np.log(2.0 * np.pi)
    assert found == pytest.approx(documented, rel=1e-9)


def test_a_cut_that_is_far_away_is_none(model):
    """Where both ends are more than 8.3 sd away, the density is that of the normal."""
    value = jnp.log(jnp.array([[70.0, 71.0], [73.0, 69.0]]))
    for sd in (0.02, 0.05):  # without and with the cut's formulas
        some = population((71.0, 70.0), (sd, sd))
        covariance = sd**2 * np.asarray(some.factor @ some.factor.T)
        mean = np.log(np.array([71.0, 70.0]))
        expected = stats.multivariate_normal.logpdf(np.asarray(value), mean, covariance)
        found = np.asarray(model.log_density(value, some)) - np.log(2.0 * np.pi)
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("kind", ["normal", "uniform"])
def test_the_likelihood_of_gaussian_draws_is_that_of_the_data(kind):
    """Data of x_1 + x_2 = 3 with sd 0.1, under a normal and a uniform prior: closed form."""
    rng, direction = np.random.default_rng(0), np.ones((2, 1))
    precision = direction @ direction.T / 0.01
    shift = direction[:, 0] * 3.0 / 0.01
    if kind == "normal":
        sd = np.array([1.0, 2.0])
        prior = sd * rng.normal(size=(200_000, 2))
        covariance = np.linalg.inv(precision + np.diag(sd**-2.0))
        draws = rng.multivariate_normal(covariance @ shift, covariance, 200_000)
        log_prior = -0.5 * np.sum((draws / sd) ** 2, axis=1)
    else:
        prior = rng.uniform(-3.0, 5.0, size=(200_000, 2))
        first = rng.uniform(-3.0, 5.0, size=1_000_000)
        draws = np.stack([first, 3.0 - first + 0.1 * rng.normal(size=first.size)], axis=1)
        draws = draws[(draws[:, 1] > -3.0) & (draws[:, 1] < 5.0)][:200_000]
        log_prior = np.zeros(len(draws))
    found = likelihood_of(draws, log_prior, prior, rng)
    # Along the line data say nothing, however the prior ends there.
    inside = np.array([[1.0, 2.0], [1.02, 2.1], [0.4, 2.6], [1.9, 1.0]])
    t = inside - found.centre
    parts = found.constant + t @ found.slope.T
    parts = parts - 0.5 * np.einsum("sk,jkl,sl->sj", t, found.precision, t)
    heights = logsumexp(parts, axis=1)
    expected = -0.5 * ((inside.sum(axis=1) - 3.0) / 0.1) ** 2
    tolerance = 0.05 if kind == "normal" else 0.25
    np.testing.assert_allclose(heights - heights[0], expected - expected[0], atol=tolerance)


def test_members_draws_are_weighted_by_population_over_prior(model, mixtures):
    """Log weights and chosen draws of two populations, by hand."""
    density, rng = density_of_population(model), np.random.default_rng(2)
    x = np.log(rng.uniform(60.0, 90.0, size=(2, 50, 2)))
    log_prior = rng.normal(size=(2, 50))
    z = np.repeat(np.asarray(jax.random.normal(jax.random.key(1), (2, density.dimension))), 4000, 0)
    weighed = density.weigh(jax.random.key(0), z, mixtures, Alone(x, log_prior))
    drawn = density.constrain(jnp.asarray(z[[0, -1]]))
    for k, rows in enumerate((slice(0, 4000), slice(4000, 8000))):
        some = jax.tree.map(lambda values, k=k: values[k], drawn)
        log_weights = np.asarray(model.log_density(jnp.asarray(x), some)) - log_prior
        exact = logsumexp(log_weights, axis=1)
        expected = (exact - np.asarray(log_likelihoods(model, some, mixtures))).sum()
        np.testing.assert_allclose(weighed.log_weight[rows], expected, rtol=1e-9)
        shares = np.exp(log_weights - exact[:, None])
        for i in range(2):
            counts = np.bincount(weighed.member_draws[rows, i], minlength=50) / 4000.0
            assert np.abs(counts - shares[i]).max() < 5.0 * np.sqrt(0.25 / 4000.0)
    assert weighed.in_use.shape == (2,)
    assert np.all((weighed.in_use >= 1.0) & (weighed.in_use <= 50.0))
