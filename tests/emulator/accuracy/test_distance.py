import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.accuracy.estimate import newton_distance, valid_state
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
    np.testing.assert_allclose(system.restrict(found.error), e, rtol=1e-6, atol=1e-12)
    assert found.gap == pytest.approx(0.5 * r @ e)
    assert found.accepted


def test_a_valid_state(beam, simulator):
    centre = simulator(beam.centre)
    state, theta = valid_state(beam, centre, 1.1 * centre, beam.centre)
    np.testing.assert_array_equal(state, jnp.where(beam.held, 0.0, 1.1 * centre))
    np.testing.assert_array_equal(theta, beam.centre)
    for bad in (-3.0 * beam.mesh.nodes, np.nan * beam.mesh.nodes):
        state, theta = valid_state(beam, centre, bad, beam.centre.at[0].set(jnp.nan))
        assert jnp.min(volume_ratio(beam, state)) > 0.0
        assert jnp.isfinite(theta).all()
