import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.mechanics.kinematics import Barriers, Strain, determinant


@pytest.mark.usefixtures("strict")
def test_measures_equal_their_definitions():
    H = 0.3 * np.random.default_rng(0).normal(size=(20, 3, 3))
    F = np.eye(3) + H
    for h, f in zip(H, F, strict=True):
        strain = Strain(jnp.asarray(h))
        assert strain.J_minus_1 == pytest.approx(np.linalg.det(f) - 1.0, abs=1e-14)
        assert strain.I1_minus_3 == pytest.approx(np.trace(f.T @ f) - 3.0, abs=1e-13)
        assert determinant(jnp.asarray(f)) == pytest.approx(np.linalg.det(f), abs=1e-14)


def test_small_strains_keep_their_digits_in_float32():
    H = (1e-5 * np.random.default_rng(1).normal(size=(3, 3))).astype(np.float32)
    exact = np.linalg.det(np.eye(3) + H.astype(np.float64)) - 1.0
    naive = np.linalg.det(np.eye(3, dtype=np.float32) + H) - np.float32(1.0)
    assert abs(float(Strain(jnp.asarray(H)).J_minus_1) - exact) < 1e-6 * abs(exact)
    assert abs(float(naive) - exact) > 1e-4 * abs(exact)  # what the formula in H avoids


def test_barriers_have_the_published_values_and_no_kink():
    barriers = Barriers()
    # J_min = 0.001 and J_start = 0.05 (Dalton et al. 2023, Section 2.4.3), with
    # beta_1 = 1 / 0.049 and beta_2 = ln 0.049 - 0.05 / 0.049.
    J = np.array([-1.0, 0.0, 0.03])
    expected = np.exp(J / 0.049 + np.log(0.049) - 0.05 / 0.049) + 0.001
    np.testing.assert_allclose(jax.vmap(barriers.limit_J)(jnp.asarray(J)), expected, rtol=1e-12)
    assert barriers.limit_J(jnp.array(0.7)) == 0.7
    assert barriers.limit_I1(jnp.array(9.0)) == 9.0
    assert barriers.limit_I1(jnp.array(1e6)) == pytest.approx(11.0)
    assert barriers.limit_I4f(jnp.array(7.0)) == 7.0
    assert barriers.limit_I4f(jnp.array(8.5)) == pytest.approx(8.0 + np.tanh(0.5))
    starts = ((barriers.limit_J, 0.05), (barriers.limit_I1, 10.0), (barriers.limit_I4f, 8.0))
    for function, at in starts:
        below, above = (jax.grad(function)(jnp.array(at + d)) for d in (-1e-9, 1e-9))
        assert below == pytest.approx(float(above), abs=1e-6)


@pytest.mark.parametrize("J", [-1e6, -1.0, 0.0, 0.05, 1.0, 1e6])
def test_barrier_gradients_are_finite_everywhere(J):
    assert np.isfinite(jax.grad(Barriers().limit_J)(jnp.array(J)))
    assert np.isfinite(jax.grad(lambda x: jnp.log(Barriers().limit_J(x)))(jnp.array(J)))
