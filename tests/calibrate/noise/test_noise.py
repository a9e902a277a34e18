"""Densities of noise against SciPy, and what a run may say of it."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.linalg import block_diag
from scipy.spatial.distance import cdist

import calibrate as cal
from calibrate.noise import (
    CorrelatedNoise,
    Sites,
    StudentTNoise,
    information_about_means,
    noise_of,
    parse_noise,
)
from emulator.core.errors import InputError
from emulator.core.gaussian_process import CORRELATIONS

POINTS = np.random.default_rng(0).uniform(0.0, 30.0, (6, 3))
MEAN = np.random.default_rng(1).normal(size=(6, 3))
DATA = MEAN + np.random.default_rng(2).normal(size=(6, 3))


def test_density_simulation_and_json():
    known, unknown = cal.GaussianNoise(sd=0.5), cal.GaussianNoise(sd_scale=2.0)
    mean, data = jnp.array([[1.0, 2.0]]), np.array([[1.5, 1.0]])
    expected = stats.norm.logpdf(data, mean, 0.5).sum()
    assert float(known.distribution(mean, {}).log_prob(data)) == pytest.approx(expected)
    given = unknown.distribution(mean, {"noise_sd": 0.5})
    assert float(given.log_prob(data)) == pytest.approx(expected)
    assert list(unknown.priors) == ["noise_sd"]
    drawn = known.simulate(np.random.default_rng(0), (4000,))
    assert drawn.std() == pytest.approx(0.5, rel=4 / np.sqrt(8000))
    with pytest.raises(InputError, match="noise 'pink' is unknown; known: gaussian"):
        noise_of({"kind": "pink"})
    with pytest.raises(InputError, match="to make data, give its standard deviation"):
        unknown.simulate(np.random.default_rng(0), (1,))


def test_student_t_is_scipys_and_forgives_an_outlier():
    known, unknown = StudentTNoise(dof=4, scale=0.3), StudentTNoise(dof=4, prior_scale=1.0)
    expected = stats.t.logpdf(DATA, 4, MEAN, 0.3).sum()
    for noise, values in ((known, {}), (unknown, {"noise_scale": 0.3})):
        density = noise.distribution(jnp.asarray(MEAN), values)
        assert float(density.log_prob(DATA)) == pytest.approx(expected, rel=1e-12)
    assert list(unknown.priors) == ["noise_scale"]
    # The pull of a residual r on the mean, (nu + 1) r / (nu s^2 + r^2), falls again.
    pull = jax.grad(lambda mean: known.distribution(mean, {}).log_prob(jnp.array([1.0])))
    for mean in (0.9, -20.0):
        r = 1.0 - mean
        assert float(pull(jnp.array([mean]))[0]) == pytest.approx(5 * r / (4 * 0.09 + r**2))
    drawn = known.simulate(np.random.default_rng(0), (4000,))
    assert stats.kstest(drawn, stats.t(4, 0.0, 0.3).cdf).pvalue > 1e-3
    assert stats.kstest(drawn, stats.norm(0.0, 0.3 * np.sqrt(2)).cdf).pvalue < 1e-3
    # As rare beyond five `upper_sd` as a Gaussian beyond five sds.
    beyond = stats.t.sf(5.0 * known.upper_sd / 0.3, 4)
    assert beyond == pytest.approx(stats.norm.sf(5.0), rel=1e-6)


def covariance(points, length, kernel, sd, spatial_sd, component):
    """sd^2 I + spatial_sd^2 K by loops, 0 between components."""
    C = np.zeros((len(points), len(points)))
    for j, k in np.ndindex(C.shape):
        s = np.linalg.norm(points[j] - points[k]) / length
        smooth = kernel == "squared_exponential"
        same = np.exp(-(s**2) / 2) if smooth else (1 + 3**0.5 * s) / np.exp(3**0.5 * s)
        C[j, k] = spatial_sd**2 * same * (component[j] == component[k]) + sd**2 * (j == k)
    return C


@pytest.mark.parametrize("kernel", CORRELATIONS)
@pytest.mark.parametrize("gaps", [False, True])
def test_correlated_noise_is_the_multivariate_normal(kernel, gaps, strict):
    sites, mean, data = Sites.of(POINTS, 3), MEAN, DATA
    if gaps:  # as entries of data with missing values are: raveled
        there = np.setdiff1d(np.arange(18), [1, 6, 7, 8, 17])
        sites = Sites(sites.positions[there], sites.component[there])
        mean, data = MEAN.ravel()[there], DATA.ravel()[there]
    C = covariance(sites.positions, 12.0, kernel, 0.3, 0.8, sites.component)
    expected = stats.multivariate_normal.logpdf(data.ravel(), mean.ravel(), C)
    noise = CorrelatedNoise(12.0, sd=0.3, spatial_sd=0.8, kernel=kernel).at(sites)
    inferred = CorrelatedNoise(12.0, sd_scale=1.0, spatial_sd_scale=1.0, kernel=kernel).at(sites)
    values = {"noise_sd": jnp.asarray(0.3), "spatial_sd": jnp.asarray(0.8)}
    assert set(inferred.priors) == set(values)
    for each, numbers in ((noise, {}), (inferred, values)):
        found = jax.jit(
            lambda y, each=each, v=numbers: each.distribution(jnp.asarray(mean), v).log_prob(y)
        )
        assert float(found(jnp.asarray(data))) == pytest.approx(expected, rel=1e-10)
    assert noise.upper_sd == pytest.approx(np.sqrt(np.linalg.eigvalsh(C).max()), rel=1e-10)
    other = CorrelatedNoise(13.0, sd=0.3, spatial_sd=0.8, kernel=kernel).at(sites)
    assert abs(float(other.distribution(jnp.asarray(mean), {}).log_prob(data)) - expected) > 1e-2


def test_the_information_about_means_is_in_closed_form():
    """The inverse covariance of Gaussian noise; of Student's t the curvature at the mean."""
    sites, mean = Sites.of(POINTS, 3), jnp.asarray(MEAN)
    heavy, values = StudentTNoise(dof=4, prior_scale=1.0), {"noise_scale": jnp.asarray(0.3)}
    np.testing.assert_allclose(heavy.information(mean, values), np.full(18, 5.0 / (4.0 * 0.09)))
    plain = cal.GaussianNoise(sd=0.5)
    correlated = CorrelatedNoise(12.0, sd=0.3, spatial_sd=0.8).at(sites)
    C = covariance(sites.positions, 12.0, "matern32", 0.3, 0.8, sites.component)
    np.testing.assert_allclose(correlated.information(mean, {}), np.linalg.inv(C), atol=1e-9)
    # Of several observations in the order in which their data are raveled.
    means = {"b": mean, "a": jnp.zeros(()), "c": jnp.zeros((2, 2))}
    together = information_about_means({"b": correlated, "a": plain, "c": plain}, means)
    expected = block_diag(np.diag([4.0]), np.linalg.inv(C), 4.0 * np.eye(4))
    np.testing.assert_allclose(together, expected, atol=1e-9)
    diagonal = information_about_means(
        {"b": heavy, "a": plain}, {n: means[n] for n in "ab"}, {"b": values}
    )
    np.testing.assert_allclose(diagonal, [4.0, *np.full(18, 5.0 / (4.0 * 0.09))])


@pytest.mark.parametrize("kernel", CORRELATIONS)
def test_each_datum_given_all_the_others(kernel, strict):
    """Against the ratio of two densities of SciPy's: of all data, and of all but one."""
    sites = Sites.of(POINTS, 3)
    order = np.random.default_rng(3).permutation(18)[:15]  # raveled, out of order, with gaps
    sites = Sites(sites.positions[order], sites.component[order])
    mean, data = MEAN.ravel()[order], DATA.ravel()[order]
    C = covariance(sites.positions, 12.0, kernel, 0.3, 0.8, sites.component)
    noise = CorrelatedNoise(12.0, sd=0.3, spatial_sd=0.8, kernel=kernel).at(sites)
    found = jax.jit(lambda y: noise.distribution(jnp.asarray(mean), {}).log_conditionals(y))
    whole = stats.multivariate_normal.logpdf(data, mean, C)
    for j, each in enumerate(np.asarray(found(jnp.asarray(data)))):
        rest = np.delete(np.arange(15), j)
        others = stats.multivariate_normal.logpdf(data[rest], mean[rest], C[rest][:, rest])
        assert each == pytest.approx(whole - others, rel=1e-9)


def test_draws_have_the_covariance():
    sites = Sites.of(POINTS, 3)
    noise = CorrelatedNoise(12.0, sd=0.3, spatial_sd=0.8).at(sites)
    C = covariance(sites.positions, 12.0, "matern32", 0.3, 0.8, sites.component)
    count, rng = 1000, np.random.default_rng(0)
    made = np.stack([noise.simulate(rng, (6, 3)).ravel() for _ in range(count)])
    drawn = noise.distribution(jnp.asarray(MEAN), {}).sample(jax.random.key(0), (count,))
    assert drawn.shape == (count, 6, 3)
    for draws in (made, np.asarray(drawn).reshape(count, -1) - MEAN.ravel()):
        # The sampling error of a covariance is sqrt((C_jj C_kk + C_jk^2) / count).
        error = np.sqrt((np.outer(np.diag(C), np.diag(C)) + C**2) / count)
        assert np.abs(draws.T @ draws / count - C).max() < 5 * error.max()


def test_noise_of_a_run_in_words_and_json():
    for text, noise in {
        "0.2": cal.GaussianNoise(sd=0.2),
        "gaussian:sd=0.2": cal.GaussianNoise(sd=0.2),
        "student_t:dof=4,scale=0.2": StudentTNoise(4.0, 0.2),
        "correlated:length=15,sd=0.1,spatial_sd=0.2,kernel=squared_exponential": CorrelatedNoise(
            15.0, 0.1, spatial_sd=0.2, kernel="squared_exponential"
        ),
    }.items():
        assert noise_of(parse_noise(text)) == noise
        assert noise_of(json.loads(json.dumps(noise.to_json()))) == noise
        (inferred,) = {"noise_sd", "noise_scale"} & set(noise.inferred(0.7).priors)
        prior = noise.inferred(0.7).priors[inferred]
        assert float(prior.scale) == 0.7
    bound = CorrelatedNoise(15.0, 0.1, spatial_sd=0.2).at(Sites.of(POINTS, 3))
    assert "sites" not in bound.to_json()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: cal.GaussianNoise(), "give either sd .known. or sd_scale"),
        (lambda: cal.GaussianNoise(sd=0.0), "standard deviation is 0.0; it must be above 0"),
        (lambda: cal.GaussianNoise(sd=np.nan), "standard deviation is nan"),
        (lambda: StudentTNoise(0.0, 1.0), "number of degrees of freedom is 0.0"),
        (lambda: StudentTNoise(4.0), "give either scale .known. or prior_scale"),
        (lambda: CorrelatedNoise(-1.0, 1.0, spatial_sd=1.0), r"correlation length \(mm\) is -1.0"),
        (lambda: CorrelatedNoise(1.0, 1.0), "give either spatial_sd .known. or spatial_sd_scale"),
        (
            lambda: CorrelatedNoise(1.0, 1.0, spatial_sd=1.0, kernel="rbf"),
            "'rbf' is unknown; known",
        ),
        (lambda: CorrelatedNoise(1.0, 1.0, spatial_sd=1.0).at(None), "has no place of its own"),
        (
            lambda: parse_noise("loud"),
            "'loud' is neither a number nor a noise; give gaussian:OPTION=VALUE",
        ),
        (lambda: parse_noise("student_t:scale=1"), "noise 'student_t': key 'dof' is missing"),
        (
            lambda: parse_noise("student_t:dof=4,sd=1"),
            "noise 'student_t': unknown key 'sd'; known: dof, prior_scale, scale",
        ),
        (lambda: parse_noise("student_t:dof=few,scale=1"), 'dof = "few"; expected a number'),
        (
            lambda: parse_noise("student_t:dof"),
            "'dof' is not option=value; give student_t:OPTION=VALUE,... of dof, scale",
        ),
    ],
)
def test_one_line_for_every_mistake(make, message):
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_nearby_points_correlate_and_components_do_not():
    """Kernels at known values: K(0) = 1, Matern 3/2 at one length, and the pairwise distances."""
    squared = cdist(POINTS, POINTS, "sqeuclidean") / 12.0**2
    assert CORRELATIONS["matern32"](np.array(1.0)) == pytest.approx(
        (1 + 3**0.5) * np.exp(-(3**0.5))
    )
    assert CORRELATIONS["squared_exponential"](np.array(1.0)) == pytest.approx(np.exp(-0.5))
    for kernel in CORRELATIONS.values():
        K = kernel(squared)
        np.testing.assert_allclose(np.diag(K), 1.0)
        assert np.linalg.eigvalsh(K).min() > 0.0
