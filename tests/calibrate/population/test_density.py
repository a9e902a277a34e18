"""The density of a hierarchy, term by term, and in any coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import calibrate as cal
from calibrate.population import population_model
from calibrate.population.density import (
    Conditions,
    Information,
    density_of_population,
    information_of,
)
from linear_support import linear_forward

LOW, HIGH = np.log(50.0), np.log(100.0)


@pytest.fixture(scope="module")
def model(beam):
    """Two members of two parameters, one with an unknown noise sd."""
    forward, observe = linear_forward(beam), cal.nodal_displacements(beam, [3, 11, 20])
    known = cal.model(forward, observe, cal.GaussianNoise(sd=0.1), check_scale=False)
    unknown = cal.model(forward, observe, cal.GaussianNoise(sd_scale=0.1), check_scale=False)
    return population_model({"first": known, "second": unknown}, eta=3.0)


def of_nothing():
    return Information(jnp.full((2, 2), 4.2), jnp.zeros((2, 2)), jnp.zeros((2, 2, 2)))


def of_data():
    precision = jnp.array([[[400.0, 90.0], [90.0, 50.0]], [[3.0, -1.0], [-1.0, 900.0]]])
    return Information(
        jnp.array([[4.0, 4.5], [4.3, 4.58]]), jnp.array([[2.0, -3.0], [8.0, 0.5]]), precision
    )


def points(density):
    return jax.random.normal(jax.random.key(3), (4, density.dimension))


@pytest.mark.slow
def test_coordinates_do_not_change_the_density(model):
    """p(w) = p(w') |det dw'/dw|, with w' the coordinates of members whose data say nothing."""
    density = density_of_population(model)
    data = {m: {"displacement": jnp.full((3, 3), 0.5)} for m in model.members}
    place = slice(_first_score(density), _first_score(density) + 4)

    log_density = jax.jit(density.log_density)

    @jax.jit
    def plain(w):
        _, scores, _ = density.constrain(w[None], of_data())
        return w.at[place].set(scores.reshape(-1))

    for w in points(density):
        height = log_density(plain(w), Conditions(data, of_nothing()))
        _, change = np.linalg.slogdet(np.asarray(jax.jit(jax.jacfwd(plain))(w)))
        found = log_density(w, Conditions(data, of_data()))
        np.testing.assert_allclose(found, height + change, rtol=1e-9)


def _first_score(density):
    """Where the scores are in the flat vector: what the members' scores alone depend on."""
    w = jnp.zeros(density.dimension)
    slopes = jax.jacfwd(lambda w: density.constrain(w[None], of_nothing())[1].ravel())(w)
    return int(np.flatnonzero(np.abs(slopes).sum(axis=0))[0])


def test_each_term_is_the_one_documented(model):
    """Up to a constant; positive and bounded unknowns have the Jacobian of their logarithm, ..."""
    density = density_of_population(model)
    data = {"first": {"displacement": jnp.full((3, 3), 0.8)}}
    noise = model.members["second"].sampled_priors["noise_sd"]

    @jax.jit
    def terms(w):
        population, z, own = density.constrain(w[None], of_nothing())
        values = model.shared_values(*(part[0] for part in population), z[0])
        first = {name: v[0] for name, v in values.items()}
        return (
            population, z, own, noise.log_prob(own["noise_sd[second]"][0]),
            model.members["first"].map_log_likelihood(first, data["first"]),
            density.log_density(w, Conditions(data, of_nothing())),
        )  # fmt: skip

    different = []
    for w in points(density):
        population, z, own, of_noise, of_first, found = terms(w)
        m, s = np.log(population.median[0]), np.asarray(population.sd[0])
        correlation = np.asarray(population.factor[0] @ population.factor[0].T)
        expected = stats.norm.logpdf(m, (LOW + HIGH) / 2, (HIGH - LOW) / 2).sum()
        # theta in (low, high) by the sigmoid: of m, d theta/dw = m' (theta - low)(high - theta)
        theta = np.asarray(population.median[0])
        expected += np.log((theta - 50.0) * (100.0 - theta) / theta).sum()
        expected += stats.halfnorm.logpdf(s, scale=(HIGH - LOW) / 4).sum() + np.log(s).sum()
        r = correlation[0, 1]
        expected += 2.0 * np.log1p(-(r**2)) + np.log1p(-(r**2))  # det(R)^(eta - 1), dr/dw
        expected += stats.norm.logpdf(z).sum()
        expected += float(of_noise) + np.log(own["noise_sd[second]"][0]) + float(of_first)
        different.append(float(found) - expected)
    np.testing.assert_allclose(different, different[0], rtol=1e-8)


def test_a_member_has_the_density_documented(model):
    """Of x by a change of variables from z, and as the cut normals of a Gaussian copula."""
    median, sd, r = np.array([70.0, 95.0]), np.array([0.15, 0.1]), -0.6
    factor = np.linalg.cholesky(np.array([[1.0, r], [r, 1.0]]))
    m, z = np.log(median), np.array([0.4, -1.1])

    def x(z):
        values = model.shared_values(jnp.array(median), jnp.array(sd), jnp.array(factor), z)
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


def test_the_information_of_gaussian_draws_is_that_of_the_data():
    """Prior N(0, 1), (0, 4); data of x_1 + x_2 = 3 with sd 0.1: closed form."""
    rng = np.random.default_rng(0)
    prior_sd, direction = np.array([1.0, 2.0]), np.array([[1.0], [1.0]])
    precision = direction @ direction.T / 0.01
    covariance = np.linalg.inv(precision + np.diag(prior_sd**-2))
    mean = covariance @ direction[:, 0] * 3.0 / 0.01
    draws = rng.multivariate_normal(mean, covariance, 200_000)
    value, slope, found = information_of(draws, prior_sd * rng.normal(size=(200_000, 2)))
    np.testing.assert_allclose(found, precision, rtol=0.02)
    np.testing.assert_allclose(slope, value / prior_sd**2, rtol=0.05)
