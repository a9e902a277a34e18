"""Damped Newton steps against SciPy's minimisers and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from emulator.core.small_newton import minimise_by_newton


def quadratic_of(function):
    """Value, slope and Hessian of a function of a point."""
    value_and_slope, hessian = jax.value_and_grad(function), jax.hessian(function)
    return lambda x: (*value_and_slope(x), hessian(x))


def rosenbrock(x):
    """Its Hessian is indefinite above the parabola, and its valley is bent."""
    return 100.0 * (x[1] - x[0] ** 2) ** 2 + (1.0 - x[0]) ** 2


def exponential(x):
    """An exponential law: a Newton step from rest overshoots by hundreds of its exponent."""
    stretch = 1.0 + x[0]
    return jnp.exp(30.0 * (stretch**2 + 2.0 / stretch - 3.0)) / 60.0 - 1e4 * x[0]


def test_a_bent_valley_against_scipy():
    for start in ([-1.2, 1.0], [0.0, 2.0]):  # the second has an indefinite Hessian
        end = jax.jit(lambda x: minimise_by_newton(quadratic_of(rosenbrock), x))(jnp.array(start))
        reference = minimize(rosenbrock, start, jac=jax.grad(rosenbrock), tol=1e-12).x
        assert bool(end.converged)
        np.testing.assert_allclose(end.x, reference, atol=1e-6)
        np.testing.assert_allclose(end.x, 1.0, atol=1e-12)
        np.testing.assert_allclose(end.hessian, jax.hessian(rosenbrock)(end.x), rtol=1e-6)
    assert np.linalg.eigvalsh(jax.hessian(rosenbrock)(jnp.array(start)))[0] < 0.0


def test_it_leaves_a_saddle():
    """Minima of x^4/4 - x^2/2 + y^2/2 are at x = -1 and 1; the Hessian is indefinite between."""
    double_well = lambda x: 0.25 * x[0] ** 4 - 0.5 * x[0] ** 2 + 0.5 * x[1] ** 2
    end = minimise_by_newton(quadratic_of(double_well), jnp.array([0.1, 3.0]))
    assert bool(end.converged)
    np.testing.assert_allclose(end.x, [1.0, 0.0], atol=1e-12)


def test_overshooting_steps_of_an_exponential():
    """The undamped step would be 1e4 over a stiffness of 3; the energy there is infinite."""
    quadratic = quadratic_of(exponential)
    value, slope, hessian = quadratic(jnp.zeros(1))
    assert not np.isfinite(exponential(-slope / hessian[0]))
    end = minimise_by_newton(quadratic, jnp.zeros(1), low=-1.0)
    assert bool(end.converged)
    stretch = 1.0 + float(end.x[0])
    assert end.x[0] > 0.1
    exponent = 30.0 * (stretch**2 + 2.0 / stretch - 3.0)
    assert np.exp(exponent) * (stretch - stretch**-2) == pytest.approx(1e4, rel=1e-10)
    assert value == pytest.approx(1.0 / 60.0)


def test_a_minimum_beyond_the_longest_step():
    """Close to a bound, at a fifth of a fifth of the first distance: several steps are cut."""
    quadratic = quadratic_of(lambda x: jnp.sum((x + 0.99) ** 2))
    end = minimise_by_newton(quadratic, jnp.zeros(2), low=-1.0)
    assert bool(end.converged)
    np.testing.assert_allclose(end.x, -0.99, atol=1e-12)
    # Where the only minimum lies beyond the bound, none is reported, and the start is returned.
    end = minimise_by_newton(quadratic, jnp.ones(2), low=0.0)
    assert not bool(end.converged)
    np.testing.assert_array_equal(end.x, 1.0)
    np.testing.assert_array_equal(end.hessian, np.eye(2))


def test_a_function_that_is_nowhere_finite():
    end = minimise_by_newton(lambda x: (jnp.nan, x, jnp.eye(1)), jnp.ones(1))
    assert not bool(end.converged)


def test_many_problems_end_where_each_does(strict):
    quadratic = lambda centre: quadratic_of(lambda x: rosenbrock(x - centre) + jnp.exp(x[0]))
    solve = lambda centre: minimise_by_newton(quadratic(centre), jnp.array([-1.2, 1.0]), low=-8.0)
    centres = jnp.array([[0.0, 0.0], [1.0, -2.0], [-5.0, 3.0], [jnp.nan, 0.0]])
    many = jax.jit(jax.vmap(solve))(centres)
    np.testing.assert_array_equal(many.converged, [True, True, True, False])
    for k, centre in enumerate(centres):
        one = solve(centre)
        np.testing.assert_allclose(many.x[k], one.x, atol=1e-12)
        assert bool(one.converged) == bool(many.converged[k])
