"""``identify before`` against posteriors of data sets: what it prints is what data would give."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.analysis.expected import expected_precision

SETS, DRAWS, WITHIN = 50, 100_000, 0.1


@pytest.mark.slow
def test_sds_are_those_of_posteriors_of_fifty_volumes():
    """One volume of a ventricle, 1 mL: its posteriors are the prior's draws, weighted."""
    forward = em.load("left_ventricle").cache()
    scene = forward.scene
    volume = cal.CavityVolume(scene)
    noise = 1.0  # mL
    told = expected_precision(cal.model(forward, volume, cal.GaussianNoise(sd=noise)))["sd"]
    rng = np.random.default_rng(5)
    thetas = scene.from_unit(jnp.asarray(rng.uniform(size=(DRAWS, 5))))
    wall = forward.at(volume.nodes)
    volumes = jax.jit(lambda t: jax.lax.map(lambda x: volume(wall(x), x), t, batch_size=256))
    V = np.asarray(volumes(thetas))
    x = np.asarray(scene.to_unit(thetas))  # on the parameters' scales: that of pressure is uniform
    sds = []
    for truth in range(SETS):
        weights = np.exp(-0.5 * ((V - V[truth] - noise * rng.normal()) / noise) ** 2)
        weights[truth] = 0.0  # the truth itself is no draw
        weights /= weights.sum()
        assert 1.0 / np.sum(weights**2) > 20.0
        sds.append(np.sqrt(weights @ (x - weights @ x) ** 2) / x.std(axis=0))
    for name, found in zip(scene.parameter_names, np.mean(sds, axis=0), strict=True):
        assert told[name] == pytest.approx(found, rel=WITHIN), name
