"""A cut normal by its scores, against SciPy's truncated normal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from calibrate.population.model import from_score, to_score

CASES = [(0.3, 0.2), (0.02, 0.1), (1.0, 0.05), (0.5, 3.0), (0.5, 0.01)]  # mean, sd on (0, 1)


def truncated(mean, sd):
    return stats.truncnorm(-mean / sd, (1.0 - mean) / sd, mean, sd)


@pytest.mark.parametrize(("mean", "sd"), CASES)
def test_scores_are_those_of_the_distribution_function(mean, sd):
    q = jnp.linspace(-5.0, 5.0, 21)
    x = from_score(q, mean, sd, 0.0, 1.0)
    expected = stats.norm.ppf(truncated(mean, sd).cdf(np.asarray(x)[5:16]))
    np.testing.assert_allclose(expected, q[5:16], atol=1e-8)
    assert bool(jnp.all((x >= 0.0) & (x <= 1.0)))


@pytest.mark.parametrize(("mean", "sd"), CASES)
def test_scores_and_values_are_each_others_inverse(mean, sd):
    q = jnp.linspace(-4.0, 4.0, 17)
    value = lambda q: from_score(q, mean, sd, 0.0, 1.0)
    x, slopes = jax.jit(jax.vmap(jax.value_and_grad(value)))(q)
    back, slope = jax.jit(lambda x: to_score(x, mean, sd, 0.0, 1.0))(x)
    np.testing.assert_allclose(back, q, atol=1e-7)
    np.testing.assert_allclose(slope, slopes, rtol=1e-6)


def test_far_from_both_ends_it_is_the_normal_itself():
    q = jnp.linspace(-6.0, 6.0, 25)
    np.testing.assert_allclose(from_score(q, 50.0, 0.5, 0.0, 100.0), 50.0 + 0.5 * q, atol=1e-6)


def test_derivatives_are_finite_however_far_the_score():
    @jax.jit
    @jax.grad
    def slope_at(arguments):
        q, mean, log_sd = arguments
        return from_score(q, mean, jnp.exp(log_sd), 0.0, 1.0)

    for q in (-60.0, -8.0, 0.0, 8.0, 60.0):
        for log_sd in (-8.0, -2.0, 2.0):
            slope = slope_at(np.array([q, 0.7, log_sd]))
            assert bool(jnp.all(jnp.isfinite(slope))), (q, log_sd)
