import jax
import numpy as np
import pytest

from calibrate.certificate.proposals import around
from calibrate.samplers import transport


@pytest.fixture(scope="module")
def bent():
    """Draws on a bent ridge."""
    x = np.random.default_rng(0).normal(size=(600, 2))
    return np.stack([x[:, 0], 0.1 * x[:, 1] + np.tanh(x[:, 0]) ** 2], axis=1)


def test_straightening_inverts_the_samplers_map(bent):
    map_ = transport.fit(bent)
    zeta = transport.straighten(map_, bent)
    back = jax.vmap(lambda one: transport.apply(map_, one))(zeta)
    np.testing.assert_allclose(back, bent, atol=1e-12)
    np.testing.assert_allclose(transport.bend(map_, zeta), bent, atol=1e-12)
    assert np.std(zeta[:, 1]) < 0.6 * np.std(bent[:, 1])


def test_the_density_integrates_to_one_and_is_the_draws(bent):
    kernels = around(bent, (0.3, 1.0), 5.0, np.random.default_rng(1))
    axis = np.linspace(-8.0, 8.0, 321)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    density = np.exp(kernels.log_density(grid)) * 0.05**2
    assert density.sum() == pytest.approx(1.0, abs=0.01)
    z = kernels.sample(np.random.default_rng(2), 4000)
    left = grid[:, 0] < -0.5
    error = np.sqrt(0.25 / 4000)
    assert abs(np.mean(z[:, 0] < -0.5) - density[left].sum()) < 4 * error


def test_a_coordinate_that_does_not_vary_has_a_density(bent):
    still = bent * np.array([1.0, 0.0])
    kernels = around(still, (0.5,), 5.0, np.random.default_rng(1))
    assert np.isfinite(kernels.log_density(still)).all()
