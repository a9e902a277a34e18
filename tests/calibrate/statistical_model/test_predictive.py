"""The correction of a map, as a Gaussian process of its errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calibrate.statistical_model.predictive import gauss_newton_step
from emulator.surrogates.correction import correct, fit_correction, no_correction


def points(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 2))


def linear(x):
    return np.stack([1.0 + x[:, 0] - 2.0 * x[:, 1], 3.0 * x[:, 0]], axis=1)


def at(correction, x):
    return np.asarray(jax.vmap(lambda one: correct(correction, one)[0])(jnp.asarray(x)))


def test_nothing_corrects_nothing():
    np.testing.assert_array_equal(at(no_correction(5, 2, 3), points(4)), np.zeros((4, 3)))


def test_a_linear_error_is_learned_everywhere():
    x = points(20)
    correction = fit_correction(x, linear(x), np.ones(2), 30)
    far = 3.0 * points(50, 1)
    np.testing.assert_allclose(at(correction, far), linear(far), rtol=1e-3, atol=1e-3)
    assert correction.at.shape == (30, 2)  # padded
    assert not correction.local


def test_a_smooth_error_is_learned_between_its_points():
    x, new = points(60), 0.7 * points(50, 1)
    bend = lambda x: np.sin(x[:, :1]) * np.array([[1.0, -2.0]])
    found = at(fit_correction(x, bend(x), np.ones(2), 60), new)
    assert np.sqrt(np.mean((found - bend(new)) ** 2)) < 0.02


def test_white_noise_is_not_learned():
    """Leave-one-out errors choose a large nugget, so that the correction stays small."""
    x, rng = points(60), np.random.default_rng(3)
    found = at(fit_correction(x, rng.normal(size=(60, 40)), np.ones(40), 60), points(50, 1))
    assert np.sqrt(np.mean(found**2)) < 0.5


def test_it_matches_a_gaussian_process_solved_otherwise():
    """Prediction k K^-1 D with all of the kernel in one matrix, linear trend included."""
    x, new = points(12), points(3, 1)
    errors = np.sin(x @ np.ones((2, 1)))
    correction = fit_correction(x, errors, np.ones(1), 12)
    found = at(correction, new)
    x, new = ((each - x.mean(axis=0)) / x.std(axis=0) for each in (x, new))
    kernel = lambda a, b: (
        1e2 * (1 + a @ b.T) + np.exp(-0.5 * ((a[:, None] - b) ** 2).sum(-1) / correction.length**2)
    )
    gaps = [
        kernel(new, x) @ np.linalg.solve(kernel(x, x) + nugget * np.eye(12), errors) - found
        for nugget in (1e-6, 1e-4, 1e-2, 1.0, 1e2)
    ]
    assert min(np.abs(gap).max() for gap in gaps) < 1e-6


def test_a_bump_far_from_what_is_likely_spoils_nothing():
    """A process through it would be wrong everywhere; none is right where it counts."""
    x = points(60)
    far = x[:, 0] > 1.0
    errors = np.where(far[:, None], 20.0, 0.0) * np.ones(2)
    correction = fit_correction(x, errors, np.ones(2), 60, ~far)
    np.testing.assert_array_equal(at(correction, x), np.zeros((60, 2)))
    assert correction.scale > 0.0  # it is known to be uncertain
    # Wrong where it counts: a poor process is better than none.
    assert np.abs(at(fit_correction(x, errors, np.ones(2), 60, far), x)).max() > 1.0


def test_errors_far_away_do_not_hide_those_of_a_narrow_posterior():
    """Data that say much: the map misses by 0.1 where it counts, and by 1e9 at the prior's ends."""
    near, far = 0.01 * points(30) + 0.3, points(20, 1)
    x, small = np.concatenate([near, far]), lambda x: 0.1 * linear(30.0 * (x - 0.3))
    errors = np.concatenate([small(near), 1e9 * linear(far) ** 2])
    correction = fit_correction(x, errors, np.ones(2), 60, np.arange(50) < 30)
    new = 0.01 * points(40, 2) + 0.3
    assert correction.local
    np.testing.assert_allclose(at(correction, new), small(new), atol=1e-4)
    # A finer mesh changes the errors, but neither the points nor the kernel.
    again = fit_correction(x, errors + 0.1, np.ones(2), 60, np.arange(50) < 30, like=correction)
    np.testing.assert_allclose(at(again, new), small(new) + 0.1, atol=1e-4)


def test_a_gauss_newton_step_against_a_dense_solve():
    """Where it is concave, the maximum of the parabola; else, with the prior's curvature there."""
    rng = np.random.default_rng(6)
    half, gradient, sd = rng.normal(size=(3, 3)), rng.normal(size=3), np.array([0.5, 1.0, 20.0])
    curvature = half @ half.T + np.diag(sd**-2)
    step, gain = gauss_newton_step(gradient, curvature, sd)
    np.testing.assert_allclose(step, np.linalg.solve(curvature, gradient))
    assert gain == pytest.approx(0.5 * gradient @ step)
    short, less = gauss_newton_step(gradient, curvature, sd, 0.01)
    assert np.linalg.norm(short / sd) == pytest.approx(0.01)
    assert 0.0 < less < gain
    assert less == pytest.approx(gradient @ short - 0.5 * short @ curvature @ short)
    bent, _ = gauss_newton_step(gradient, -np.diag(sd**-2), sd)
    np.testing.assert_allclose(bent, sd**2 * gradient)


def kernel_by_autodiff(x, length):
    """The covariance of values and derivatives, by JAX's derivatives of the kernel in its text."""

    def k(a, b):
        return 1e2 * (1.0 + a @ b) + jnp.exp(-0.5 * jnp.sum((a - b) ** 2) / length**2)

    def block(a, b):
        top = jnp.concatenate([k(a, b)[None], jax.grad(k, 1)(a, b)])
        rest = jax.jacfwd(jax.grad(k, 1), 0)(a, b).T
        return jnp.concatenate([top[None], jnp.concatenate([jax.grad(k)(a, b)[:, None], rest], 1)])

    whole = jax.vmap(lambda a: jax.vmap(lambda b: block(a, b))(x))(x)
    return np.asarray(whole.transpose(0, 2, 1, 3).reshape(2 * [x.size + len(x)]))


def waves(x):
    """Two functions (n, 2) and their derivatives (n, q, 2)."""
    a, b = x.T
    values = np.stack([np.sin(a + 0.5 * b), np.exp(0.4 * b) * a], axis=1)
    in_a = np.stack([np.cos(a + 0.5 * b), np.exp(0.4 * b)], axis=1)
    in_b = np.stack([0.5 * np.cos(a + 0.5 * b), 0.4 * np.exp(0.4 * b) * a], axis=1)
    return values, np.stack([in_a, in_b], axis=1)


def test_derivatives_and_errors_left_out_are_those_of_the_process_solved_otherwise():
    """The covariance by automatic differentiation; each run left out by a solve without it."""
    x = points(12)
    values, slopes = waves(x)
    c = fit_correction(x, values, np.ones(2), 12, slopes=slopes)
    at_runs = jnp.asarray((x - c.centre) / c.width)
    observed = np.concatenate([values[:, None], slopes * c.width[:, None]], axis=1)
    y, unit = observed.reshape(-1, 2), np.tile([1.0, *2 * [c.length**-2.0]], len(x))
    K = kernel_by_autodiff(at_runs, c.length) + c.nugget * np.diag(unit)
    size = len(K)
    np.testing.assert_allclose(K @ c.inverse[:size, :size], np.eye(size), atol=1e-4)
    ratios = []
    for run in range(len(x)):
        left = np.arange(size) // 3 != run
        weights = np.linalg.solve(K[np.ix_(left, left)], K[left, 3 * run])
        variance = K[3 * run, 3 * run] - weights @ K[left, 3 * run]
        ratios.append(np.mean((y[3 * run] - weights @ y[left]) ** 2) / variance)
    assert c.scale == pytest.approx(np.mean(ratios), rel=1e-3)


def test_derivatives_say_as_much_as_many_runs():
    x, new = points(15), points(200, 1)
    values, slopes = waves(x)
    some = slopes.copy()
    some[::2] = np.nan  # of half of the runs none is known
    error = lambda c: np.sqrt(np.mean((at(c, new) - waves(new)[0]) ** 2))
    plain, half, whole = (
        error(fit_correction(x, values, np.ones(2), 20, slopes=s)) for s in (None, some, slopes)
    )
    assert whole < 0.25 * plain
    assert whole < half < plain
