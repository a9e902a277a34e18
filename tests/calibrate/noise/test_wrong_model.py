"""What a discrepancy does to a posterior when the model is wrong, in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
from linear_support import LinearForward

TRUTH = jnp.array([75.0, 75.0])


@pytest.fixture
def bent(beam):
    """u linear in theta and in x; the body itself bends a little, which no theta can do."""
    x = beam.mesh.nodes[:, 0] / 100.0
    matrix = np.zeros((len(x), 3, 2))
    matrix[:, 2, 0], matrix[:, 1, 1] = -0.2 * x, 0.2 * x
    forward = LinearForward(beam, np.arange(len(x)), matrix, np.zeros((len(x), 3)))
    wrong = 1.5 * np.stack([0 * x, x**2 - 0.5 * x, x**2 - 0.5 * x], axis=1)
    data = np.asarray(forward(TRUTH)) + wrong
    return forward, data + np.random.default_rng(0).normal(0.0, 0.1, data.shape)


def estimate(model, data, numbers):
    """Least-squares theta and its covariance, from the density's derivatives: it is Gaussian."""
    checked = model.check_data(data)
    values = {name: jnp.asarray(v) for name, v in numbers.items()}

    def density(theta):
        u = model.forward(theta)[None]
        return model.log_density(values, model.observe(u, theta[None]), checked)

    covariance = np.linalg.inv(-np.asarray(jax.hessian(density)(TRUTH)))
    return np.asarray(TRUTH) + covariance @ np.asarray(jax.grad(density)(TRUTH)), covariance


@pytest.mark.slow
def test_it_widens_the_posterior_until_it_covers_the_truth(beam, bent):
    forward, data = bent
    observe, noise = cal.nodal_displacements(beam), cal.GaussianNoise(sd=0.1)
    plain = cal.model(forward, observe, noise)
    honest = cal.model(forward, observe, cal.CorrelatedNoise(50.0, sd=0.1, spatial_sd_scale=0.5))
    assert honest.names == ("mu", "lam", "spatial_sd")
    mean, covariance = estimate(plain, data, {})
    assert np.abs(mean - TRUTH).max() > 5.0 * np.sqrt(covariance[0, 0])  # sure, and wrong
    mean, covariance = estimate(honest, data, {"spatial_sd": 0.5})
    assert np.abs(mean - TRUTH).max() < 2.0 * np.sqrt(covariance[0, 0])
    # Generalised least squares by NumPy: (A^T C^-1 A)^-1.
    s = np.sqrt(3.0) * np.linalg.norm(observe.points[:, None] - observe.points, axis=-1) / 50.0
    C = np.kron(0.25 * (1.0 + s) * np.exp(-s), np.eye(3)) + 0.01 * np.eye(135)
    A = forward.matrix.reshape(-1, 2)
    np.testing.assert_allclose(covariance, np.linalg.inv(A.T @ np.linalg.solve(C, A)), rtol=1e-9)


@pytest.mark.slow
def test_its_size_is_inferred_and_vanishes_where_the_model_is_right(beam, bent):
    """The profile likelihood of its sd at the estimate of theta: about 0 for data of the model."""
    forward, data = bent
    right = np.asarray(forward(TRUTH)) + np.random.default_rng(1).normal(0.0, 0.1, data.shape)
    noise = cal.CorrelatedNoise(50.0, sd=0.1, spatial_sd_scale=0.5)
    model = cal.model(forward, cal.nodal_displacements(beam), noise)
    sds = np.geomspace(0.003, 3.0, 30)
    best = {}
    for name, values in (("wrong", data), ("right", right)):
        checked = model.check_data(values)

        def density(sd, values=values, checked=checked):
            theta, _ = estimate(model, values, {"spatial_sd": sd})
            numbers = {"spatial_sd": jnp.asarray(sd)}
            u = model.forward(jnp.asarray(theta))[None]
            means = model.observe(u, jnp.asarray(theta)[None])
            return float(model.log_density(numbers, means, checked))

        best[name] = sds[np.argmax([density(sd) for sd in sds])]
    assert best["right"] < 0.03 < 0.1 < best["wrong"] < 1.0
