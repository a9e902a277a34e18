"""One point through time: objectivity, order, rates, and steps of no and of infinite length."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import find_law
from emulator.viscosity.overstress import (
    Memory,
    at_rest,
    histories,
    isochoric,
    isochoric_stress,
    linearised,
    memory_after,
    potential,
    step_after,
)
from emulator.viscosity.series import Series

SERIES = Series(jnp.array([0.4, 0.2]), jnp.array([0.3, 5.0]))
LAW = find_law("holzapfel_ogden")
FIBRE = jnp.array([0.8, 0.6, 0.0])


def energy(H):
    return LAW.energy(Strain(H, None, FIBRE), 1.0, 3.0, 5.0, 6.0, 40.0)


def motion(t):
    """A displacement gradient (n, 3, 3) that stretches, shears and changes the volume."""
    H = np.zeros((len(t), 3, 3))
    H[:, 0, 0], H[:, 1, 1] = 0.2 * np.sin(t), -0.1 * np.sin(1.3 * t)
    H[:, 0, 1], H[:, 2, 2] = 0.3 * np.sin(0.7 * t), 0.02 * np.sin(2.0 * t)
    return jnp.asarray(H)


@jax.jit
def stresses(H, intervals):
    """First Piola-Kirchhoff stresses (n, 3, 3) along displacement gradients (n, 3, 3)."""

    def advance(memory, row):
        H, interval = row
        step = step_after(memory, SERIES, interval)
        P = jax.grad(potential(energy, step))(H)
        return memory_after(memory, SERIES, interval, isochoric_stress(energy, H)), P

    return jax.lax.scan(advance, at_rest(SERIES), (H, intervals))[1]


def test_a_spinning_frame_turns_the_stress_only():
    t = np.linspace(0.0, 3.0, 31)
    H, intervals = motion(t), jnp.asarray(np.diff(t, prepend=0.0))
    c, s, zero, one = np.cos(2.0 * t), np.sin(2.0 * t), np.zeros(31), np.ones(31)
    about_z = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)
    about_x = np.array([[one, zero, zero], [zero, c, s], [zero, -s, c]]).transpose(2, 0, 1)
    R = about_z @ about_x
    turned = R @ (np.asarray(H) + np.eye(3)) - np.eye(3)
    P, spinning = stresses(H, intervals), stresses(jnp.asarray(turned), intervals)
    np.testing.assert_allclose(spinning, R @ np.asarray(P), atol=1e-12)
    assert np.abs(P).max() > 1.0


def test_rates_without_end_and_none_are_the_two_elastic_laws():
    t = np.linspace(0.0, 3.0, 31)
    H, intervals = motion(t), jnp.asarray(np.diff(t, prepend=0.0))
    instant = jax.vmap(jax.grad(energy))(H)
    np.testing.assert_allclose(stresses(H, 1e-12 * intervals), instant, atol=1e-9)
    np.testing.assert_allclose(stresses(H, 0.0 * intervals), instant, atol=1e-12)
    relaxed = lambda H: energy(H) - 0.6 * energy(isochoric(H))
    limit = jax.vmap(jax.grad(relaxed))(H)
    np.testing.assert_allclose(stresses(H, 1e13 * intervals), limit, atol=1e-9)
    np.testing.assert_allclose(stresses(H, jnp.full(31, jnp.inf)), limit, atol=1e-12)
    assert np.abs(limit - instant).max() > 0.5


def test_second_order_in_the_step_and_the_integral():
    """Against the convolution of dS/dt by Gauss points, which knows no recurrence."""
    end = 2.0
    F = np.asarray(motion(np.array([end]))[0]) + np.eye(3)
    points, weights = np.polynomial.legendre.leggauss(60)
    s = 0.5 * end * (1.0 + points)
    of_time = lambda t: isochoric_stress(energy, _motion(t))
    rates = jax.vmap(jax.jacfwd(of_time))(jnp.asarray(s))
    kernel = np.exp(-(end - s)[:, None] / np.asarray(SERIES.times)) @ np.asarray(SERIES.fractions)
    Q = np.einsum("q,qij->ij", 0.5 * end * weights * kernel, rates)
    S_iso = np.asarray(of_time(end))
    exact = np.asarray(jax.grad(energy)(_motion(end))) + F @ (Q - 0.6 * S_iso)
    errors = []
    for count in (40, 80, 160):
        t = np.linspace(0.0, end, count + 1)
        P = stresses(motion(t), jnp.asarray(np.diff(t, prepend=0.0)))
        errors.append(np.asarray(P[-1]) - exact)
    sizes = [np.abs(error).max() for error in errors]
    assert sizes[0] / sizes[1] == pytest.approx(4.0, abs=0.1)
    assert sizes[1] / sizes[2] == pytest.approx(4.0, abs=0.05)
    assert np.abs(4.0 * errors[2] - errors[1]).max() / 3.0 < 2e-7  # extrapolated: of fourth order


def _motion(t):
    return jnp.array(
        [
            [0.2 * jnp.sin(t), 0.3 * jnp.sin(0.7 * t), 0.0],
            [0.0, -0.1 * jnp.sin(1.3 * t), 0.0],
            [0.0, 0.0, 0.02 * jnp.sin(2.0 * t)],
        ]
    )


def test_the_isochoric_stress_is_the_slope_of_its_energy_and_does_no_work_on_volume():
    H = motion(np.array([1.0]))[0]
    F = H + jnp.eye(3)
    S = isochoric_stress(energy, H)
    P = jax.grad(lambda H: energy(isochoric(H)))(H)
    np.testing.assert_allclose(F @ S, P, atol=1e-13)
    assert abs(float(jnp.vdot(S, F.T @ F))) < 1e-12
    np.testing.assert_allclose(S, S.T, atol=1e-13)


def test_stress_and_moduli_of_a_step_are_those_of_its_potential():
    H = motion(np.array([1.0]))[0]
    memory = Memory(0.1 * jnp.stack([jnp.eye(3), jnp.diag(FIBRE)]), jnp.diag(FIBRE))
    step = step_after(memory, SERIES, jnp.asarray(0.5))
    moduli = lambda H: (jax.grad(energy)(H), jax.hessian(energy)(H))
    of_step = potential(energy, step, incompressible=True)
    P, C = linearised(moduli, step, H)
    np.testing.assert_allclose(P, jax.grad(of_step)(H), atol=1e-12)
    np.testing.assert_allclose(C, jax.hessian(of_step)(H), atol=1e-11)


def test_derivatives_in_times_exist_for_steps_of_no_and_of_infinite_length():
    def scale(tau, interval):
        series = Series(jnp.array([0.5]), tau[None])
        return step_after(at_rest(series), series, interval).scale

    for interval in (0.0, 1e-12, 1.0, jnp.inf):
        assert np.isfinite(jax.grad(scale)(jnp.asarray(2.0), jnp.asarray(interval)))
    x = 0.5
    exact = 0.5 * (-np.exp(-x) / 2.0 + (1.0 - np.exp(-x)) / (2.0 * x))
    assert float(jax.grad(scale)(jnp.asarray(2.0), jnp.asarray(1.0))) == pytest.approx(exact)


def test_tests_of_different_length_have_their_own_times():
    times = np.array([0.0, 1.0, 3.0, 0.5, 0.7])
    of = histories({"a": np.arange(3), "b": np.arange(3, 5)}, times)
    np.testing.assert_array_equal(of.rows, [[0, 1, 2], [3, 4, 4]])
    np.testing.assert_allclose(of.intervals, [[0.0, 1.0, 2.0], [0.5, 0.2, 0.0]])
    back = of.along(SERIES, lambda memory, interval, x: (memory, x), (jnp.arange(5),))
    np.testing.assert_array_equal(back, np.arange(5))
    walls = histories({"": np.arange(6)}, np.array([0.0, 1.0]), size=3)
    np.testing.assert_array_equal(walls.rows, [[0, 3], [1, 4], [2, 5]])
