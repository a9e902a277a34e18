"""Errors integrated out, fixed modes and modes that vary together, against dense covariances."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from calibrate.model_error.marginal import Amplitude, ModelError, SizedModes, VaryingModes, diagonal
from emulator.core.errors import InputError

MEANS = {"a": jnp.array([1.0, -2.0]), "b": jnp.array([[3.0, 0.5], [1.5, -1.0]])}
RESIDUAL = {"a": jnp.array([0.3, 0.1]), "b": jnp.array([[-0.2, 0.4], [0.0, 0.7]])}
FLAT = np.concatenate([np.ravel(MEANS["a"]), np.ravel(MEANS["b"])])


@pytest.fixture(scope="module")
def information():
    half = np.random.default_rng(0).normal(size=(6, 6))
    return half @ half.T + np.eye(6)


def error_of(information, fixed):
    """Four modes that vary, two of them of an inferred size, after ``fixed`` (s, 6)."""
    rng = np.random.default_rng(1)
    weights, strength, modes, mixing = diagonal(fixed, information)
    names = tuple(map(str, range(len(fixed))))
    first = ModelError(weights, strength, modes, mixing=mixing, names=names)
    varying = VaryingModes(
        modes=rng.normal(size=(4, 6)),
        shares=0.3 * rng.normal(size=(4, 6)),
        sized=np.array([0.0, 1.0, 1.0, 0.0]),
        information=np.asarray(first.information_left(jnp.asarray(information), jnp.zeros(0), {})),
    )
    return replace(first, varying=varying, size_name="size", size_scale=0.5)


@pytest.fixture(scope="module", params=[0, 3], ids=["varying", "fixed and varying"])
def error(request, information):
    return error_of(information, np.random.default_rng(2).normal(size=(request.param, 6)))


def dense(error, size):
    """All modes V (r, 6) where the inferred size is ``size``."""
    varying = error.varying
    alpha = np.where(varying.sized > 0.0, size, 1.0)[:, None]
    return np.vstack([error.modes, alpha * (varying.modes + varying.shares * FLAT)])


def ratio(error, size):
    return error.log_ratio(jnp.array([7.0, size]), RESIDUAL, MEANS)


@pytest.mark.parametrize("size", [0.0, 0.4, 2.0])
def test_the_ratio_and_the_information_are_those_of_dense_covariances(error, information, size):
    C, V = np.linalg.inv(information), dense(error, size)
    residual = np.concatenate([np.ravel(RESIDUAL["a"]), np.ravel(RESIDUAL["b"])])
    expected = [multivariate_normal(np.zeros(6), S).logpdf(residual) for S in (C + V.T @ V, C)]
    assert float(ratio(error, size)) == pytest.approx(expected[0] - expected[1], rel=1e-10)
    left = error.information_left(jnp.asarray(information), jnp.array([size]), MEANS)
    np.testing.assert_allclose(left, np.linalg.inv(C + V.T @ V), atol=1e-10)


def test_noise_of_each_number_alone_may_be_a_vector(error):
    of_each = np.diagonal(error.varying.information)
    by_vector, dense_too = (
        replace(error, varying=replace(error.varying, information=W))
        for W in (of_each, np.diag(of_each))
    )
    np.testing.assert_allclose(ratio(by_vector, 0.3), ratio(dense_too, 0.3), rtol=1e-12)


@pytest.mark.parametrize("fixed", [0, 3])
@pytest.mark.parametrize("alone", [False, True], ids=["correlated noise", "independent noise"])
def test_modes_of_an_inferred_size_are_the_same_once_they_are_made_diagonal(
    information, fixed, alone
):
    W = np.diagonal(information) if alone else information
    whole = np.diag(W) if alone else W
    rng = np.random.default_rng(5)
    before, V = rng.normal(size=(fixed, 6)), rng.normal(size=(4, 6))
    weights, strength, modes, mixing = diagonal(before, W)
    first = ModelError(weights, strength, modes, mixing=mixing, size_name="size", size_scale=0.5)
    error = replace(first, sized=SizedModes(*diagonal(V, W, first)[:3]))
    C = np.linalg.inv(whole)
    residual = np.concatenate([np.ravel(RESIDUAL["a"]), np.ravel(RESIDUAL["b"])])
    for size in (0.0, 0.4, 2.0):
        S = C + before.T @ before + size**2 * V.T @ V
        expected = [multivariate_normal(np.zeros(6), each).logpdf(residual) for each in (S, C)]
        assert float(ratio(error, size)) == pytest.approx(expected[0] - expected[1], rel=1e-10)
        left = error.information_left(jnp.asarray(whole), jnp.array([size]), MEANS)
        np.testing.assert_allclose(left, np.linalg.inv(S), atol=1e-10)
    largest = error.largest(MEANS)
    np.testing.assert_allclose(
        largest.T @ largest, before.T @ before + 1.5**2 * V.T @ V, atol=1e-10
    )
    keys = jax.random.split(jax.random.key(0), 40_000)
    drawn = jax.vmap(lambda key: error.draw(key, jnp.array([0.4]), MEANS))(keys)
    flat = np.concatenate([np.reshape(drawn[n] - MEANS[n], (len(keys), -1)) for n in MEANS], axis=1)
    np.testing.assert_allclose(np.cov(flat.T), before.T @ before + 0.16 * V.T @ V, atol=0.2)
    back = ModelError.restore(error.arrays(), error.words)
    assert back.fingerprint == error.fingerprint
    assert back.priors.keys() == {"size"}
    with pytest.raises(InputError, match="'size' is inferred"):
        error.unknowns(RESIDUAL)


def test_it_is_differentiable_and_batched(error):
    sizes = jnp.linspace(0.1, 2.0, 5)
    slopes = jax.jit(jax.vmap(jax.grad(lambda size: ratio(error, size))))(sizes)
    by_differences = [(ratio(error, s + 1e-5) - ratio(error, s - 1e-5)) / 2e-5 for s in sizes]
    np.testing.assert_allclose(slopes, by_differences, rtol=1e-6)


def test_replicates_have_its_covariance(error):
    keys = jax.random.split(jax.random.key(0), 40_000)
    drawn = jax.vmap(lambda key: error.draw(key, jnp.array([0.4]), MEANS))(keys)
    flat = np.concatenate([np.reshape(drawn[n] - MEANS[n], (len(keys), -1)) for n in MEANS], axis=1)
    V = dense(error, 0.4)
    np.testing.assert_allclose(np.cov(flat.T), V.T @ V, atol=0.2)
    np.testing.assert_array_equal(error.largest(MEANS), dense(error, 1.5))


def test_arrays_of_every_part_are_restored(error, information):
    rng = np.random.default_rng(3)
    size = Amplitude(rng.normal(size=(9, 2)), rng.normal(size=9), 0.3, np.zeros(2), np.ones(2))
    weights, strength, modes, _ = diagonal(error.modes, information)
    learned = ModelError(weights, strength, modes, amplitude=size, of_mesh=True)
    for each in (error, replace(error, varying=None), learned, replace(learned, of_mesh=False)):
        back = ModelError.restore(each.arrays(), each.words)
        assert back.fingerprint == each.fingerprint
        assert back.words == each.words
        assert (back.of_mesh, back.of_fem) == (each.of_mesh, each.of_fem)
        assert back.priors.keys() == each.priors.keys()
    with pytest.raises(TypeError, match="missing"):
        ModelError.restore({"modes": modes}, {})
