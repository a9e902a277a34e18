"""Polynomials fitted to values of known error."""

import numpy as np
import pytest

from emulator.surrogates.polynomial import degrees_up_to, legendre
from emulator.training.regression import Values, best_degree, fit

RNG = np.random.default_rng(0)


def cubic(x):
    return np.stack([x[:, 0] ** 3 - x[:, 1] * x[:, 0], 2.0 * x[:, 1] ** 2 + 1.0], axis=1)


def values(count, error=1e-6):
    x = RNG.random((count, 2))
    return Values(x, cubic(x), np.full(count, error))


def test_a_polynomial_is_found_again():
    x = RNG.random((50, 2))
    np.testing.assert_allclose(fit(values(30), 3, 1e-3).at(x), cubic(x), atol=1e-12)


def test_a_value_that_is_far_off_and_says_so_changes_nothing():
    known = values(30)
    known.fields[4] += 100.0
    known.error[4] = 1e9
    x = RNG.random((50, 2))
    np.testing.assert_allclose(fit(known, 3, 1e-3).at(x), cubic(x), atol=1e-8)


def test_the_fit_is_the_weighted_least_squares_solution():
    known = values(30)
    known.fields[:] += RNG.normal(size=known.fields.shape)
    known.error[:] = RNG.uniform(0.01, 1.0, size=30)
    weight = 1.0 / (known.error + 0.1)[:, None]
    P = legendre(known.position, degrees_up_to(2, 2))
    expected = np.linalg.lstsq(weight * P, weight * known.fields)[0]
    np.testing.assert_allclose(fit(known, 2, 0.1).coefficients, expected, rtol=1e-10)


@pytest.mark.parametrize(("now", "best"), [(1, 2), (2, 3), (3, 3)])
def test_new_values_choose_the_degree(now, best):
    known = values(60)
    known.fields[:] += 1e-3 * RNG.normal(size=known.fields.shape)  # which more terms would follow
    assert best_degree(known, values(20), now, 1e-3) == best


def test_too_few_values_leave_the_degree():
    assert best_degree(values(3), values(20), 4, 1e-3) == 4
    assert fit(values(4), 3, 1e-3).degree == 1
    assert fit(values(1), 3, 1e-3).degree == 0


def test_terms_have_a_mean_square_of_one_and_no_mean_product():
    nodes, weights = np.polynomial.legendre.leggauss(6)
    x = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2) / 2.0 + 0.5
    mass = np.outer(weights, weights).ravel() / 4.0
    P = legendre(x, degrees_up_to(2, 4))
    np.testing.assert_allclose((P * mass[:, None]).T @ P, np.eye(15), atol=1e-13)
