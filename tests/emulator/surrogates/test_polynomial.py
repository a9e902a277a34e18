"""A polynomial as a part of an emulator, and its fit to samples of known error."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.surrogates.polynomial import (
    Polynomial,
    Samples,
    best_degree,
    compressed,
    degrees_up_to,
    fit,
    legendre,
    terms,
)

RNG = np.random.default_rng(1)


def test_terms_by_their_number():
    for parameters, degree in ((1, 4), (2, 3), (5, 2)):
        assert len(degrees_up_to(parameters, degree)) == terms(parameters, degree)


def test_terms_are_numpys_products():
    degrees, x = degrees_up_to(2, 3), RNG.random((4, 2))
    for row, alpha in enumerate(degrees):
        expected = np.ones(4)
        for j, k in enumerate(alpha):
            unit = np.polynomial.legendre.Legendre.basis(k, domain=[0.0, 1.0])
            expected *= np.sqrt(2 * k + 1) * unit(x[:, j])
        np.testing.assert_allclose(legendre(x, degrees)[:, row], expected, rtol=1e-13)
    np.testing.assert_allclose(legendre(jnp.asarray(x), degrees), legendre(x, degrees), rtol=1e-13)


def test_fewer_modes_are_off_by_no_more_than_was_allowed():
    """Root mean square over box and nodes, by Gauss points."""
    degrees = degrees_up_to(2, 4)
    fields = RNG.normal(size=(15, 7, 3)) * 10.0 ** -np.arange(15)[:, None, None]
    whole = Polynomial(degrees, np.eye(15), fields)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    x = jnp.asarray(np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2) / 2.0 + 0.5)
    mass = np.outer(weights, weights).ravel() / 4.0
    for error in (1e-2, 1e-6, 0.0):
        found = compressed(degrees, fields, error)
        off = np.mean(np.sum(np.asarray(found(x) - whole(x)) ** 2, axis=-1), axis=-1)
        assert np.sqrt(mass @ off) <= error + 1e-14
        single = np.array_equal(found.modes, found.modes.astype(np.float32))
        assert single == (error > 1e-7)
    assert len(compressed(degrees, fields, 1e-2).modes) < 5
    assert len(compressed(degrees, 0.0 * fields, 1.0).modes) == 1


def test_the_cache_is_the_part_over_some_nodes():
    part = Polynomial(degrees_up_to(3, 2), RNG.normal(size=(10, 4)), RNG.normal(size=(4, 9, 3)))
    nodes, x = np.array([8, 0, 3]), jnp.array([0.2, 0.9, 0.5])
    cached = part.cache(nodes)
    found = cached.offset + jnp.tensordot(cached.coefficients(x), cached.modes, axes=1)
    np.testing.assert_allclose(found, part(x)[nodes], rtol=1e-13)
    assert jax.jit(cached.coefficients)(x).shape == (4,)


def cubic(x):
    return np.stack([x[:, 0] ** 3 - x[:, 1] * x[:, 0], 2.0 * x[:, 1] ** 2 + 1.0], axis=1)


def samples(count, error=1e-6):
    x = RNG.random((count, 2))
    return Samples(x, cubic(x), np.full(count, error))


def test_a_polynomial_is_found_again():
    x = RNG.random((50, 2))
    np.testing.assert_allclose(fit(samples(30), 3, 1e-3).at(x), cubic(x), atol=1e-12)


def test_a_value_that_is_far_off_and_says_so_changes_nothing():
    known = samples(30)
    known.fields[4] += 100.0
    known.error[4] = 1e9
    x = RNG.random((50, 2))
    np.testing.assert_allclose(fit(known, 3, 1e-3).at(x), cubic(x), atol=1e-8)


def test_the_fit_is_the_weighted_least_squares_solution():
    known = samples(30)
    known.fields[:] += RNG.normal(size=known.fields.shape)
    known.error[:] = RNG.uniform(0.01, 1.0, size=30)
    weight = 1.0 / (known.error + 0.1)[:, None]
    P = legendre(known.position, degrees_up_to(2, 2))
    expected = np.linalg.lstsq(weight * P, weight * known.fields)[0]
    np.testing.assert_allclose(fit(known, 2, 0.1).coefficients, expected, rtol=1e-10)


@pytest.mark.parametrize(("now", "best"), [(1, 2), (2, 3), (3, 3)])
def test_new_values_choose_the_degree(now, best):
    known = samples(60)
    known.fields[:] += 1e-3 * RNG.normal(size=known.fields.shape)  # which more terms would follow
    assert best_degree(known, samples(20), now, 1e-3) == best


def test_too_few_values_leave_the_degree():
    assert best_degree(samples(3), samples(20), 4, 1e-3) == 4
    assert fit(samples(4), 3, 1e-3).degree == 1
    assert fit(samples(1), 3, 1e-3).degree == 0


def test_terms_have_a_mean_square_of_one_and_no_mean_product():
    nodes, weights = np.polynomial.legendre.leggauss(6)
    x = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2) / 2.0 + 0.5
    mass = np.outer(weights, weights).ravel() / 4.0
    P = legendre(x, degrees_up_to(2, 4))
    np.testing.assert_allclose((P * mass[:, None]).T @ P, np.eye(15), atol=1e-13)
