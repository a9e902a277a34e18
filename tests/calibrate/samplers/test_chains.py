"""Chains on threads."""

import threading
from dataclasses import replace

import jax
import numpy as np

from calibrate.samplers import Context, NUTSOptions, density_of
from calibrate.samplers.chains import Programs
from calibrate.samplers.nuts import NUTS
from linear_support import linear_problem


def test_chains_run_side_by_side_and_draw_what_they_draw_alone(beam):
    """Two chains meet inside the density: neither could go on without the other."""
    model, data = linear_problem(beam)
    posterior = density_of(model)
    together = threading.Barrier(2, timeout=60.0)

    def met(z, data):
        value = posterior.log_density(z, data)
        return value + jax.pure_callback(wait, jax.ShapeDtypeStruct((), float), value)

    def wait(value):
        together.wait()
        return np.zeros_like(value)

    def start(key, data, map_):
        z = jax.random.normal(key, (posterior.dimension,))
        return z, met(z, data)

    keys = jax.random.split(jax.random.key(0), 4)
    programs = Programs(start, lambda state, data, map_, count: (state, None), at_once=2)
    states, heights = programs.start(keys, data, None)
    for key, z, height in zip(keys, states, heights, strict=True):
        np.testing.assert_array_equal(z, jax.random.normal(key, (posterior.dimension,)))
        np.testing.assert_allclose(height, posterior.log_density(z, data), rtol=1e-12)

    def drawn(at_once):
        options = NUTSOptions(draws=40, warmup=40, rounds=1)
        return NUTS.sample(replace(posterior, at_once=at_once), data, options, Context(seed=3))

    np.testing.assert_array_equal(drawn(3).z, drawn(1).z)
