"""Errors that vary with what is unknown, against dense covariances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from calibrate.statistical_model.varying_error import VaryingError, eliminated


@pytest.fixture(scope="module")
def error():
    rng = np.random.default_rng(0)
    half = rng.normal(size=(6, 6))
    return VaryingError(
        modes=rng.normal(size=(4, 6)),
        shares=0.3 * rng.normal(size=(4, 6)),
        sized=np.array([0.0, 1.0, 1.0, 0.0]),
        information=half @ half.T + np.eye(6),
        name="size",
        scale=0.5,
    )


MEANS = {"a": jnp.array([1.0, -2.0]), "b": jnp.array([[3.0, 0.5], [1.5, -1.0]])}
RESIDUAL = {"a": jnp.array([0.3, 0.1]), "b": jnp.array([[-0.2, 0.4], [0.0, 0.7]])}


def dense(error, size):
    flat = np.concatenate([np.ravel(MEANS["a"]), np.ravel(MEANS["b"])])
    V = np.where(error.sized > 0.0, size, 1.0)[:, None] * (error.modes + error.shares * flat)
    return np.linalg.inv(error.information), V


def ratio(error, size):
    return error.log_ratio(jnp.array([7.0, size]), RESIDUAL, MEANS)


@pytest.mark.parametrize("size", [0.0, 0.4, 2.0])
def test_the_ratio_is_that_of_dense_covariances(error, size):
    C, V = dense(error, size)
    residual = np.concatenate([np.ravel(RESIDUAL["a"]), np.ravel(RESIDUAL["b"])])
    expected = [multivariate_normal(np.zeros(6), S).logpdf(residual) for S in (C + V.T @ V, C)]
    assert float(ratio(error, size)) == pytest.approx(expected[0] - expected[1], rel=1e-10)
    left = error.information_left(error.information, jnp.array([size]), MEANS)
    np.testing.assert_allclose(left, np.linalg.inv(C + V.T @ V), atol=1e-10)


def test_noise_of_each_number_alone_may_be_a_vector(error):
    of_each = np.diagonal(error.information)
    by_vector = VaryingError(error.modes, error.shares, error.sized, of_each, "size", 0.5)
    dense_too = VaryingError(error.modes, error.shares, error.sized, np.diag(of_each), "size", 0.5)
    np.testing.assert_allclose(ratio(by_vector, 0.3), ratio(dense_too, 0.3), rtol=1e-12)


def test_it_is_differentiable_and_batched(error):
    sizes = jnp.linspace(0.1, 2.0, 5)
    slopes = jax.jit(jax.vmap(jax.grad(lambda size: ratio(error, size))))(sizes)
    by_differences = [(ratio(error, s + 1e-5) - ratio(error, s - 1e-5)) / 2e-5 for s in sizes]
    np.testing.assert_allclose(slopes, by_differences, rtol=1e-6)


def test_replicates_have_its_covariance(error):
    keys = jax.random.split(jax.random.key(0), 40_000)
    drawn = jax.vmap(lambda key: error.draw(key, jnp.array([0.4]), MEANS))(keys)
    flat = np.concatenate([np.reshape(drawn[n] - MEANS[n], (len(keys), -1)) for n in MEANS], axis=1)
    _, V = dense(error, 0.4)
    np.testing.assert_allclose(np.cov(flat.T), V.T @ V, atol=0.2)


def test_elimination_is_the_inverse_and_the_determinant():
    rng = np.random.default_rng(1)
    half, rows = rng.normal(size=(7, 7)), rng.normal(size=(7, 3))
    M = half @ half.T + np.eye(7)
    pivots, reduced = eliminated(jnp.asarray(M), jnp.asarray(rows))
    assert float(jnp.prod(pivots)) == pytest.approx(np.linalg.det(M))
    found = (reduced.T / pivots) @ reduced
    np.testing.assert_allclose(found, rows.T @ np.linalg.solve(M, rows), atol=1e-10)
