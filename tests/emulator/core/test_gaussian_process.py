"""Against JAX's derivatives of the plain kernel, and textbook conditioning with dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import check_grad
from scipy.special import gamma, kv
from scipy.stats import multivariate_normal
from sklearn.gaussian_process.kernels import RBF, Matern

from emulator.core import gaussian_process as kernel
from emulator.core.gaussian_process import (
    JITTER,
    Features,
    Regression,
    covariance,
    fit_lengths,
    fold,
    negative_log_likelihood,
)

COUNT, PARAMETERS = 6, 2
EACH = 1 + PARAMETERS


def psi(x):
    """Five features of a position: three are not linear."""
    return jnp.array([x[0], 0.7 * x[1], jnp.sin(2.0 * x[0]), x[0] * x[1], 0.5 * x[1] ** 2])


def plain(x, y):
    """Matern 7/2 of the features; no derivatives are told to JAX here."""
    a = jnp.sqrt(7.0 * jnp.sum((psi(x) - psi(y)) ** 2))
    return (1.0 + a + 2.0 / 5.0 * a**2 + a**3 / 15.0) * jnp.exp(-a)


def features_of(points):
    return Features(jax.vmap(psi)(points), jax.vmap(jax.jacfwd(psi))(points))


@pytest.fixture(scope="module")
def points():
    return jnp.asarray(np.random.default_rng(0).random((COUNT, PARAMETERS)))


@pytest.fixture(scope="module")
def features(points):
    return features_of(points)


@pytest.fixture(scope="module")
def observations(points):
    """Three functions with their derivatives, run by run."""
    f = lambda x: jnp.array([jnp.sin(3.0 * x[0] + x[1]), jnp.exp(x[0] * x[1]), x[1] ** 3 - x[0]])
    derivatives = jax.vmap(jax.jacfwd(f))(points).transpose(0, 2, 1)
    return jnp.concatenate([jax.vmap(f)(points)[:, None], derivatives], axis=1).reshape(-1, 3)


def test_the_kernel_is_materns(features):
    """By its definition with a Bessel function."""
    distance = np.array([0.03, 0.4, 1.0, 2.7])
    z = np.sqrt(7.0) * distance
    expected = 2.0 ** (1.0 - 3.5) / gamma(3.5) * z**3.5 * kv(3.5, z)
    np.testing.assert_allclose(kernel.matern72(distance**2), expected, rtol=1e-12)


def test_radial_derivatives_by_differences_and_at_zero():
    squared, h = jnp.array([0.02, 0.5, 3.0]), 1e-6
    for order in range(3):
        k = lambda s, order=order: kernel.matern72(s, order)
        expected = (k(squared + h) - k(squared - h)) / (2 * h)
        np.testing.assert_allclose(jax.vmap(jax.grad(k))(squared), expected, rtol=1e-7)
        if order < 2:
            np.testing.assert_allclose(kernel.matern72(squared, order + 1), expected, rtol=1e-7)
    # To all digits where two inputs meet, not only finite.
    chain = [kernel.matern72]
    for _ in range(3):
        chain.append(jax.grad(chain[-1]))
    expected = [1.0, -0.7, 49.0 / 60.0, -343.0 / 120.0]
    np.testing.assert_allclose([f(0.0) for f in chain], expected, rtol=1e-11)


def test_blocks_are_derivatives_of_the_plain_kernel(points, features):
    ours = np.asarray(covariance(features)).reshape(COUNT, EACH, COUNT, EACH)
    one, other = np.nonzero(~np.eye(COUNT, dtype=bool))  # the plain one has none at itself
    pairs = lambda f: jax.jit(jax.vmap(f))(points[one], points[other])
    np.testing.assert_allclose(ours[one, 0, other, 0], pairs(plain), atol=1e-13)
    in_y, in_x = pairs(jax.grad(plain, 1)), pairs(jax.grad(plain, 0))
    np.testing.assert_allclose(ours[one, 0, other, 1:], in_y, atol=1e-12)
    np.testing.assert_allclose(ours[one, 1:, other, 0], in_x, atol=1e-12)
    mixed = pairs(jax.jacfwd(jax.grad(plain, 1), 0)).transpose(0, 2, 1)
    np.testing.assert_allclose(ours[one, 1:, other, 1:], mixed, atol=1e-11)
    for k, J in enumerate(features.derivative):  # of itself with itself: 1, 0, 7/5 J'J
        expected = np.block([[np.eye(1), np.zeros((1, 2))], [np.zeros((2, 1)), 1.4 * J.T @ J]])
        np.testing.assert_allclose(ours[k, :, k], expected, atol=1e-12)


def test_symmetric_and_positive_definite(features):
    K = np.asarray(covariance(features))
    np.testing.assert_allclose(K, K.T, rtol=0, atol=1e-15)
    assert np.linalg.eigvalsh(K).min() > 1e-8


@pytest.mark.parametrize("library", [np, jnp])
def test_regression_against_dense_matrices(library):
    """NumPy in, NumPy out."""
    rng = np.random.default_rng(4)
    x, y = rng.random((8, 2)), rng.normal(size=(8, 3))
    K = np.exp(-0.5 * np.sum((x[:, None] - x) ** 2, axis=-1)) + 1e-2 * np.eye(8)
    regression = Regression.of(library.asarray(K))
    assert isinstance(regression.factor, np.ndarray) == (library is np)
    np.testing.assert_allclose(regression.weights(library.asarray(y)), np.linalg.solve(K, y))
    np.testing.assert_allclose(regression.inverse(), np.linalg.inv(K))


@jax.jit
def conditioned(points, observations):
    """What the mean needs."""
    features = features_of(points)
    return features.value, *fold(features, kernel.fit_weights(features, observations))


@jax.jit
def predict(x, known):
    return kernel.mean(psi(x), *known)


@jax.jit
def predict_derivatives(x, known):
    return jax.jacfwd(predict)(x, known)


@pytest.fixture(scope="module")
def known(points, observations):
    return conditioned(points, observations)


def test_the_mean_against_textbook_conditioning(points, features, observations, known):
    across_to = jax.jit(jax.vmap(jax.value_and_grad(plain, 1), (None, 0)))
    K = np.asarray(covariance(features))
    K = K + JITTER * np.diag(np.diagonal(K))
    for x in (jnp.array([0.31, 0.77]), jnp.array([1.4, -0.3])):
        value, derivatives = across_to(x, points)
        across = np.concatenate([value[:, None], derivatives], axis=1).ravel()
        expected = across @ np.linalg.solve(K, np.asarray(observations))
        np.testing.assert_allclose(predict(x, known), expected, atol=1e-8)


def test_values_and_derivatives_are_met_at_the_runs(points, observations, known):
    given = np.asarray(observations).reshape(COUNT, EACH, 3)
    for x, (value, *derivatives) in zip(points, given, strict=True):
        np.testing.assert_allclose(predict(x, known), value, atol=1e-6)
        np.testing.assert_allclose(predict_derivatives(x, known).T, derivatives, atol=1e-6)


def test_smooth_at_a_run(points, known):
    """Curvature there is that next to it; reverse mode agrees with forward."""
    curvature = jax.jit(jax.jacfwd(predict_derivatives))
    at, beside = curvature(points[2], known), curvature(points[2] + 1e-7, known)
    assert np.isfinite(at).all()
    np.testing.assert_allclose(at, beside, rtol=1e-4, atol=1e-4)
    derivatives = lambda x: predict_derivatives(x, known)
    step = 1e-4 * jnp.array([1.0, 0.0])
    central = (derivatives(points[2] + step) - derivatives(points[2] - step)) / 2e-4
    np.testing.assert_allclose(at[:, :, 0], central, rtol=1e-3, atol=1e-3)
    backward = jax.jit(jax.jacrev(predict))(points[2], known)
    np.testing.assert_allclose(backward, derivatives(points[2]), atol=1e-9)


def test_misfit_against_scipy(features, observations):
    """At each output's most likely variance; the rest is N (1 + log 2 pi) / 2."""
    K = np.asarray(covariance(features))
    K = K + JITTER * np.diag(np.diagonal(K))
    size = len(K)
    total = 0.0
    for y in np.asarray(observations).T:
        variance = y @ np.linalg.solve(K, y) / size
        densities = [
            multivariate_normal(None, s * variance * K).logpdf(y) for s in (0.8, 1.0, 1.25)
        ]
        assert np.argmax(densities) == 1
        total -= densities[1]
    expected = total / (3 * size) - 0.5 * (1.0 + np.log(2.0 * np.pi))
    assert negative_log_likelihood(features, observations) == pytest.approx(expected, rel=1e-6)


def test_lengths_are_those_of_least_misfit(features, observations):
    lengths = fit_lengths(features, observations)
    scaled = lambda logs: negative_log_likelihood(features.scaled(jnp.exp(logs)), observations)
    objective, slope = jax.jit(scaled), jax.jit(jax.grad(scaled))
    best = objective(np.log(lengths))
    start = np.array([0.0, 0.0, -1.0, -1.0, -1.0])
    assert check_grad(objective, slope, start) < 2e-4 * np.linalg.norm(slope(start))
    assert best < objective(start)
    rng = np.random.default_rng(1)
    for _ in range(5):
        near = np.clip(np.log(lengths) + 0.2 * rng.normal(size=5), -6.0, 3.0)
        assert objective(near) > best - 1e-6


def test_two_equal_runs_change_nothing(points, observations, known):
    twice = jnp.concatenate([points, points[:1]])
    doubled = jnp.concatenate([observations, observations[:EACH]])
    x = jnp.array([0.4, 0.6])
    again = predict(x, conditioned(twice, doubled))
    np.testing.assert_allclose(again, predict(x, known), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "theirs"), [("matern32", Matern(nu=1.5)), ("squared_exponential", RBF())]
)
def test_correlations_by_name_are_scikit_learns(name, theirs):
    points = np.random.default_rng(0).random((5, 2))
    squared = np.sum((points[:, None] - points) ** 2, axis=-1)
    for distances in (squared, jnp.asarray(squared)):
        np.testing.assert_allclose(kernel.CORRELATIONS[name](distances), theirs(points), rtol=1e-12)
