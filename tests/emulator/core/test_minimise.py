"""The guarded minimiser: known minima, bounds, points without a finite value, no unknowns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.core.minimise import minimise

bowl = jax.value_and_grad(lambda x: jnp.sum((x - jnp.array([1.0, -2.0])) ** 2))


def test_a_quadratic_is_minimised_at_its_minimum():
    minimum = minimise(bowl, np.zeros(2))
    assert minimum.converged
    assert minimum.x == pytest.approx([1.0, -2.0], abs=1e-6)
    assert minimum.value == pytest.approx(0.0, abs=1e-12)


def test_the_minimum_stays_within_bounds():
    minimum = minimise(bowl, np.zeros(2), low=-0.5, high=np.array([0.25, 3.0]))
    assert minimum.x == pytest.approx([0.25, -0.5])


def test_points_without_a_finite_value_are_stepped_over():
    # The logarithm's argument is negative where a full Newton step from the start would lead.
    function = jax.value_and_grad(lambda x: 1e3 * (x[0] - jnp.log(x[0])))
    minimum = minimise(function, np.array([5.0]), tolerance=1e-14)
    assert minimum.converged
    assert minimum.x == pytest.approx([1.0], abs=1e-4)


def test_a_start_without_a_finite_value_is_no_minimum():
    minimum = minimise(lambda x: (np.nan, np.zeros(1)), np.zeros(1))
    assert not minimum.converged
    assert minimum.value == np.inf


def test_iterations_end_before_convergence():
    rosenbrock = jax.value_and_grad(lambda x: (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2)
    assert not minimise(rosenbrock, np.array([-1.2, 1.0]), iterations=3).converged
    assert minimise(rosenbrock, np.array([-1.2, 1.0])).converged


def test_a_function_of_nothing_has_its_value():
    minimum = minimise(lambda x: (3.0, x), np.zeros(0))
    assert (minimum.value, minimum.converged) == (3.0, True)
