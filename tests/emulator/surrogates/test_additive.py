"""An emulator of all parts: series, network, residual."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.fem import design
from emulator.fem.campaign import run_campaign
from emulator.store import read_arrays
from emulator.surrogates import Architecture, augment, load, save_emulator
from emulator.surrogates.additive import BASES, fresh
from emulator.surrogates.discrepancy import fit_residual
from emulator.surrogates.taylor import expand
from emulator.training.basis import mechanical_modes

SMALL = Architecture(steps=1, latent=8, hidden=(16, 16), decoder="separable", modes=3)


@pytest.fixture(scope="module")
def whole(beam, simulator):
    """Series of order 2, five mechanical modes, weights drawn, and a residual over all of it."""
    series = expand(simulator, order=2)
    scale = np.array([0.5, 1.0, 2.0])
    basis = (mechanical_modes(simulator, series, 5) / scale).astype(np.float32)
    emulator = fresh(beam, augment(beam), SMALL, series, scale, 0, basis)
    leaves, structure = jax.tree.flatten(emulator.weights)
    rng = np.random.default_rng(2)
    leaves = [leaf + 0.01 * rng.normal(size=leaf.shape).astype(np.float32) for leaf in leaves]
    emulator = replace(emulator, weights=jax.tree.unflatten(structure, leaves))
    runs = run_campaign(simulator, design(beam, 8, 0), slopes=True, predictor=series)
    cached = emulator.cache()
    residual = fit_residual(beam, runs, series, lambda x: cached(beam.from_unit(x)))
    return replace(emulator, residual=residual)


THETAS = jnp.array([[0.1, 0.9], [0.5, 0.5], [1.0, 0.0], [0.3, 0.2]])


@pytest.mark.parametrize("base", BASES)
def test_cached_equals_uncached_whatever_the_residual_stands_on(whole, beam, base):
    emulator = replace(whole, base=base)
    cached = jax.jit(emulator.cache())
    for theta in beam.from_unit(THETAS):
        exact = emulator(theta)
        atol = 1e-5 * float(jnp.max(jnp.abs(exact)))
        np.testing.assert_allclose(cached(theta), exact, atol=atol, rtol=0)


def test_each_part_has_its_say(whole, beam):
    theta = beam.from_unit(THETAS[3])
    values = [replace(whole, residual=None)(theta), *(replace(whole, base=b)(theta) for b in BASES)]
    for k, one in enumerate(values):
        for other in values[:k]:
            assert float(jnp.abs(one - other).max()) > 1e-6


def test_over_the_network_it_is_fem_at_its_runs(whole, beam, simulator):
    theta = design(beam, 8, 0)[4]  # a corner of the box, and a run
    error = jnp.abs(whole(theta) - simulator(theta)).max()
    bare = jnp.abs(replace(whole, residual=None)(theta) - simulator(theta)).max()
    assert error < 1e-4 * bare


def test_a_batch_is_its_rows(whole, beam):
    cached = whole.cache()
    thetas = beam.from_unit(THETAS)
    together = cached(thetas)
    assert together.shape == (4, len(beam.mesh.nodes), 3)
    np.testing.assert_allclose(together, jnp.stack([cached(t) for t in thetas]), atol=1e-12)
    np.testing.assert_allclose(jax.vmap(cached)(thetas), together, atol=1e-12)


def test_only_nodes_asked_for_are_decoded(whole, beam):
    nodes = np.array([44, 3])
    cached = whole.cache()
    theta = beam.from_unit(THETAS[0])
    np.testing.assert_allclose(cached.at(nodes)(theta), cached(theta)[nodes], atol=1e-12)
    np.testing.assert_allclose(whole.cache(nodes)(theta), cached(theta)[nodes], atol=1e-12)


def test_what_the_residual_does_not_stand_on_is_not_evaluated(whole, beam):
    work = {
        base: jax.jit(replace(whole, base=base).cache()).lower(beam.centre).compile()
        for base in BASES
    }
    flops = {base: compiled.cost_analysis()["flops"] for base, compiled in work.items()}
    assert flops["nothing"] < flops["series"] < flops["network"]


def test_the_gradient_is_that_of_the_value(whole, beam):
    cached = whole.cache()
    weights = jnp.asarray(np.random.default_rng(0).normal(size=beam.held.shape))
    value = lambda x: jnp.vdot(weights, cached(beam.from_unit(x)))
    x, step = jnp.array([0.3, 0.7]), 1e-2
    slope = jax.grad(value)(x)
    for k in range(2):
        e = jnp.zeros(2).at[k].set(step)
        wide = (value(x + 2 * e) - value(x - 2 * e)) / (4 * step)
        narrow = (value(x + e) - value(x - e)) / (2 * step)
        # The branch is float32: Richardson's difference of a step this long is good to 1e-3.
        assert float(slope[k]) == pytest.approx(float((4 * narrow - wide) / 3), rel=2e-3)


def test_saved_and_loaded_it_is_the_same(whole, beam, tmp_path):
    save_emulator(whole, tmp_path)
    again = load(tmp_path, beam)
    assert again.fingerprint == whole.fingerprint
    assert again.base == whole.base
    np.testing.assert_array_equal(again(beam.centre), whole(beam.centre))


def test_numbers_float32_can_hold_are_kept_in_half_the_room(whole, tmp_path):
    rounded = np.asarray(whole.residual.modes, dtype=np.float32).astype(np.float64)
    small = replace(whole, residual=replace(whole.residual, modes=jnp.asarray(rounded)))
    save_emulator(small, tmp_path / "narrow")
    arrays, _ = read_arrays(tmp_path / "narrow" / "weights.safetensors")
    assert arrays["['residual']['modes']"].dtype == np.float32
    assert arrays["['residual']['slopes']"].dtype == np.float64
    assert load(tmp_path / "narrow", whole.scene).fingerprint == small.fingerprint


def test_an_untrained_separable_network_is_its_series(beam, simulator):
    series = expand(simulator, order=1)
    emulator = fresh(beam, augment(beam), SMALL, series, np.ones(3), 0)
    x = jnp.array([0.2, 0.6])
    expected = jnp.where(beam.held, 0.0, series(x))
    np.testing.assert_allclose(emulator(beam.from_unit(x)), expected, atol=1e-12)


def test_an_unknown_decoder():
    with pytest.raises(em.InputError, match="decoder 'dense': use pointwise or separable"):
        Architecture(decoder="dense")
