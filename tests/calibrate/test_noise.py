import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import calibrate as cal
from calibrate.noise import noise_from_json
from emulator.errors import InputError


def test_density_simulation_and_json():
    known, unknown = cal.GaussianNoise(sd=0.5), cal.GaussianNoise(sd_scale=2.0)
    mean, data = jnp.array([[1.0, 2.0]]), np.array([[1.5, 1.0]])
    expected = stats.norm.logpdf(data, mean, 0.5).sum()
    assert float(known.distribution(mean, {}).log_prob(data)) == pytest.approx(expected)
    given = unknown.distribution(mean, {"noise_sd": 0.5})
    assert float(given.log_prob(data)) == pytest.approx(expected)
    assert list(unknown.priors) == ["noise_sd"]
    drawn = known.simulate(np.random.default_rng(0), (4000,))
    assert drawn.std() == pytest.approx(0.5, rel=4 / np.sqrt(8000))
    for noise in (known, unknown):
        assert noise_from_json(noise.to_json()) == noise
    with pytest.raises(InputError, match="noise kind 'pink' is unknown; known: gaussian"):
        noise_from_json({"kind": "pink"})
    with pytest.raises(InputError, match="to make data, give its standard deviation"):
        unknown.simulate(np.random.default_rng(0), (1,))
