import jax
import jax.numpy as jnp
import numpy as np

from emulator.surrogates.taylor import constant, expand
from emulator.training.hybrid import mechanical_modes


def test_modes_are_orthogonal_in_the_tangent_and_span_the_series(beam, simulator):
    series = expand(simulator, order=2)
    modes = mechanical_modes(simulator, series, 40)
    assert len(modes) == len(series.indices)
    system = simulator.system
    force = lambda u: system.residual(u, beam.centre)
    pulled = [jax.jvp(force, (series.displacement,), (jnp.asarray(m),))[1] for m in modes]
    products = np.stack([[system.restrict(jnp.asarray(m)) @ f for f in pulled] for m in modes])
    scale = np.sqrt(np.diag(products))
    np.testing.assert_allclose(products / scale[:, None] / scale, np.eye(len(modes)), atol=1e-4)
    assert (np.diff(scale) < 0).all()  # the most energetic comes first
    flat = modes.reshape(len(modes), -1)
    for term in np.asarray(series.derivatives).reshape(len(modes), -1):
        left = term - np.linalg.lstsq(flat.T, term, rcond=None)[0] @ flat
        assert np.linalg.norm(left) < 1e-6 * np.linalg.norm(term)


def test_a_constant_has_no_modes(beam, simulator):
    u = simulator(beam.centre)
    assert mechanical_modes(simulator, constant(np.full(2, 0.5), u), 5).shape == (0, *u.shape)
