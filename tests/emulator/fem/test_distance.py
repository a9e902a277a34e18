import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.error_bar import error_bar
from emulator.fem.assembly import System
from emulator.fem.distance import gradients_distance, newton_distance, sound_state
from emulator.mechanics.energy import volume_ratio


@pytest.fixture(scope="module")
def near(beam, simulator):
    """A field a little off the solution at the centre."""
    push = np.random.default_rng(1).normal(0.0, 1e-3, beam.held.shape)
    return simulator(beam.centre) + np.where(beam.held, 0.0, push)


def test_newton_against_a_dense_solve(beam, simulator, near):
    system = simulator.system
    found = newton_distance(system, near, beam.centre)
    K = jax.jacfwd(lambda v: system.residual(near + system.extend(v), beam.centre))(
        jnp.zeros(len(system.free))
    )
    r = np.asarray(system.residual(near, beam.centre))
    e = np.linalg.solve(np.asarray(K), r)
    np.testing.assert_allclose(system.restrict(found.move), e, rtol=1e-6, atol=1e-12)
    assert found.gap == pytest.approx(0.5 * r @ e)
    assert found.settled


def test_conjugate_gradients_against_numpy(beam, simulator, near):
    """Two iterations of the textbook, with dense matrices."""
    theta, centre = beam.from_unit(jnp.array([0.6, 0.4])), simulator(beam.centre)
    system = System(beam, "cholmod")

    def dense(u, at):
        along = lambda v: system.residual(u + system.extend(v), at)
        return np.asarray(jax.jacfwd(along)(jnp.zeros(len(system.free))))

    M, K = dense(centre, beam.centre), dense(near, theta)
    left = np.asarray(system.residual(near, theta))
    x, p, before = np.zeros_like(left), 0.0, 1.0
    for k in range(2):
        z = np.linalg.solve(M, left)
        p = z + (left @ z / before if k else 0.0) * p
        before = left @ z
        length = before / (p @ K @ p)
        x, left = x + length * p, left - length * K @ p
    values = np.asarray(system.pattern.safe_values(system.tangent(centre, beam.centre)))
    found = gradients_distance(system, values, 2, near, theta)
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


def test_a_climbing_step_is_seen(beam, simulator):
    """Squeezed along its axis beyond buckling, a beam's tangent is indefinite."""
    squeezed = -0.4 * beam.mesh.nodes * np.array([1.0, 0.0, 0.0])
    system = simulator.system
    K = jax.jacfwd(lambda v: system.residual(squeezed + system.extend(v), beam.centre))(
        jnp.zeros(len(system.free))
    )
    assert np.linalg.eigvalsh(np.asarray(K)).min() < 0.0
    bar = error_bar(em.fem_forward(simulator), simulator)
    estimate = bar.of_field(jnp.asarray(squeezed), beam.centre)
    assert estimate.guard.indefinite
    assert "indefinite" in estimate.guard.sentence(beam)
    true = np.asarray(squeezed - simulator(beam.centre))
    ratio = float(estimate.max) / np.linalg.norm(true, axis=1).max()
    assert 0.5 < ratio < 2.0
