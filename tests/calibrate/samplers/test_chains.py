"""Chains on threads."""

import threading
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calibrate.samplers import NUTSOptions, density_of
from calibrate.samplers.chains import Chains, Programs
from calibrate.samplers.nuts import NUTS
from calibrate.samplers.protocol import Context
from linear_support import PRIOR_MEAN, PRIOR_SD, closed_form, linear_forward, linear_problem


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


def test_of_many_unknowns_chains_begin_white_at_a_mode(beam):
    model, data = linear_problem(beam)
    assert not density_of(model).whitened  # it has two
    posterior = replace(density_of(model), piloted=False, whitened=True)
    chains = Chains(NUTS, posterior, data, NUTSOptions(draws=20, warmup=20), Context(seed=3))
    chains.begin(jax.random.key(0))
    mode, root = chains.map_.centre, np.asarray(chains.map_.root)
    of_z = lambda z: posterior.log_density(z, data)
    np.testing.assert_allclose(root.T @ jax.grad(of_z)(mode), 0.0, atol=0.3)
    np.testing.assert_allclose(root.T @ jax.hessian(of_z)(mode) @ root, -np.eye(2), atol=1e-4)
    of_w = chains.programs.start(jax.random.split(jax.random.key(1), 2), data, chains.map_)[1]
    assert (of_w > of_z(mode) - 10.0).all()  # they start near it
    forward = linear_forward(beam)
    mean, covariance = closed_form(forward, [3, 11, 20], data, 0.1, PRIOR_MEAN, PRIOR_SD)
    drawn = NUTS.sample(posterior, data, NUTSOptions(draws=400, warmup=100), Context(seed=3)).z
    values = posterior.constrain(jnp.asarray(drawn.reshape(-1, 2)))
    for k, name in enumerate(beam.parameter_names):
        sd = float(np.sqrt(covariance[k, k]))
        assert float(values[name].mean()) == pytest.approx(mean[k], abs=0.2 * sd)
        assert float(values[name].std()) == pytest.approx(sd, rel=0.15)
