"""Data replicated at draws of the prior, by solves that are driven from Python."""

import jax
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.posterior.predictions import _programs, prior_replicates


@pytest.mark.slow
@pytest.mark.parametrize("states", [("",), ("a", "b")], ids=["one state", "two states"])
def test_solved_data_are_the_traced_program_s(beam, simulator, states):
    forward = em.fem_forward(simulator)
    observe = {f"end@{s}" if s else "end": cal.nodal_displacements(beam, "right") for s in states}
    model = cal.model(forward, observe, {"end": cal.GaussianNoise(sd=0.2)})
    key = jax.random.key(0)
    found = prior_replicates(model, key, 5)
    draws, data, valid = _programs(model).prior(jax.random.split(key, 5))
    assert np.asarray(valid).all()
    for name, values in found.draws.items():
        np.testing.assert_array_equal(values, draws[name])
    assert set(found.data) == set(observe)
    for name, values in found.data.items():
        np.testing.assert_allclose(values, data[name], atol=1e-8)
