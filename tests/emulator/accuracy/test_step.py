import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.accuracy.step import gradients_distance, newton_distance, sound_state
from emulator.fem.assembly import System
from emulator.fem.energy import volume_ratio


@pytest.fixture(scope="module")
def near(beam, simulator):
    """A field a little off the solution at the centre."""
    push = np.random.default_rng(1).normal(0.0, 1e-3, beam.held.shape)
    return simulator(beam.centre) + np.where(beam.held, 0.0, push)


@pytest.fixture(scope="module")
def dense(beam, simulator):
    """Dense tangent over the free degrees of freedom, by differentiating the residual."""
    system = simulator.system
    nothing = jnp.zeros(len(system.free))
    along = lambda v, u, theta: system.residual(u + system.extend(v), theta)
    tangent = jax.jit(lambda u, theta: jax.jacfwd(along)(nothing, u, theta))
    return lambda u, theta: np.asarray(tangent(u, theta))


def test_newton_against_a_dense_solve(beam, simulator, near, dense):
    system = simulator.system
    found = jax.jit(lambda u, theta: newton_distance(system, u, theta))(near, beam.centre)
    r = np.asarray(system.residual(near, beam.centre))
    e = np.linalg.solve(dense(near, beam.centre), r)
    np.testing.assert_allclose(system.restrict(found.move), e, rtol=1e-6, atol=1e-12)
    assert found.gap == pytest.approx(0.5 * r @ e)
    assert found.settled


def test_conjugate_gradients_against_numpy(beam, simulator, near, dense):
    """Two iterations of the textbook, with dense matrices."""
    theta, centre = beam.from_unit(jnp.array([0.6, 0.4])), simulator(beam.centre)
    system = System(beam)
    M, K = dense(centre, beam.centre), dense(near, theta)
    left = np.asarray(system.residual(near, theta))
    x, p, before = np.zeros_like(left), 0.0, 1.0
    for k in range(2):
        z = np.linalg.solve(M, left)
        p = z + (left @ z / before if k else 0.0) * p
        before = left @ z
        length = before / (p @ K @ p)
        x, left = x + length * p, left - length * K @ p
    tangent = jax.jit(lambda *at: system.pattern.safe_values(system.tangent(*at)))
    values = np.asarray(tangent(centre, beam.centre))
    found = jax.jit(lambda *at: gradients_distance(system, values, 2, *at))(near, theta)
    np.testing.assert_allclose(system.restrict(found.move), x, rtol=1e-5, atol=1e-9)
    assert not found.indefinite


def test_a_sound_state(beam, simulator):
    centre = simulator(beam.centre)
    state, theta = sound_state(beam, centre, 1.1 * centre, beam.centre)
    np.testing.assert_array_equal(state, jnp.where(beam.held, 0.0, 1.1 * centre))
    np.testing.assert_array_equal(theta, beam.centre)
    for bad in (-3.0 * beam.mesh.nodes, np.nan * beam.mesh.nodes):
        state, theta = sound_state(beam, centre, bad, beam.centre.at[0].set(jnp.nan))
        assert jnp.min(volume_ratio(beam, state)) > 0.0
        assert jnp.isfinite(theta).all()
