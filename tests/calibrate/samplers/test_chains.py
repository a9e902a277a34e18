"""Chains: starts by Pathfinder (in the bulk, in both modes, where random ones fail), threads."""

import threading
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
from calibrate.samplers import Context, NUTSOptions, density_of
from calibrate.samplers.chains import Programs, pathfinder_start
from calibrate.samplers.nuts import NUTS
from emulator.core.errors import InputError
from linear_support import linear_problem


def starts(log_density, count=64, scale=2.0):
    def one(key):
        here, there = jax.random.split(key)
        candidates = jax.random.uniform(here, (16, 2), float, -scale, scale)
        heights = jax.vmap(log_density)(candidates)
        return pathfinder_start(there, log_density, candidates, heights)

    return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), count)))


@pytest.mark.slow
def test_starts_of_a_sharp_gaussian_are_its_draws():
    mean, sd = jnp.array([7.0, -5.0]), jnp.array([0.01, 0.3])
    z = (starts(lambda x: -0.5 * jnp.sum(((x - mean) / sd) ** 2)) - mean) / sd
    assert abs(z.mean(axis=0)).max() < 4 / np.sqrt(len(z))
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=4 / np.sqrt(2 * len(z)))


@pytest.mark.slow
def test_both_modes_are_found():
    def log_density(x):
        return jax.nn.logsumexp(
            jnp.array([-0.5 * jnp.sum((x - centre) ** 2) / 0.01 for centre in (-1.5, 1.5)])
        )

    right = (starts(log_density)[:, 0] > 0).mean()
    assert 0.2 < right < 0.8


@pytest.mark.slow
def test_points_of_density_zero_are_no_starts():
    def log_density(x):
        return jnp.where(x[0] > 1.0, -0.5 * jnp.sum((x - 1.5) ** 2) / 0.04, -jnp.inf)

    found = starts(log_density)
    assert (found[:, 0] > 1.0).all()
    # Where it is zero everywhere one of the candidates comes back, not NaN.
    assert np.isfinite(starts(lambda x: -jnp.inf + 0.0 * x[0], count=4)).all()


@pytest.mark.slow
def test_chains_may_start_by_pathfinder(beam):
    model, data = linear_problem(beam)
    options = cal.NUTSOptions(100, 200, chains=2, rounds=1, start="pathfinder")
    posterior = cal.sample(model, data, options=options)
    assert posterior.summary()["mu"]["r_hat"] < 1.05
    assert '"start": "pathfinder"' in posterior.tree.attrs["sampler_options"]
    with pytest.raises(InputError, match="NUTS: start is 'prior'; it is random or pathfinder"):
        cal.NUTSOptions(start="prior")


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
