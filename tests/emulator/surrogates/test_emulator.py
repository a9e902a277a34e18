"""An emulator of all parts: Taylor series, polynomial, network, discrepancy model."""

from dataclasses import replace
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.store import read_arrays
from emulator.fem import design
from emulator.fem.campaign import run_campaign
from emulator.surrogates import Architecture, Emulator, augment, load, save_emulator
from emulator.surrogates.discrepancy import fit_discrepancy
from emulator.surrogates.emulator import PARTS
from emulator.surrogates.network import fresh
from emulator.surrogates.network.graph import AugmentedGraph
from emulator.surrogates.polynomial import compressed, degrees_up_to
from emulator.surrogates.taylor import constant, expand
from network_support import drawn

SMALL = Architecture(steps=1, latent=8, hidden=(16, 16), decoder="separable", modes=3)
# A family's network cannot be on a beam; tests/emulator/surrogates/test_family.py has it, and
# tests/emulator/training/test_two_meshes.py the part from a coarser mesh.
NAMES = tuple(name for name in PARTS if name not in ("family", "coarse"))


@pytest.fixture(scope="module")
def whole(beam, simulator):
    """Series of order 2, weights drawn, and a discrepancy model over both."""
    series = expand(simulator, order=2)
    scale = np.array([0.5, 1.0, 2.0])
    network = drawn(fresh(beam, augment(beam), SMALL, scale, 0), 0.01)
    fields = 0.01 * np.random.default_rng(2).normal(size=(6, *beam.held.shape))
    polynomial = compressed(degrees_up_to(2, 2), fields, 0.0)
    emulator = Emulator(beam, taylor=series, polynomial=polynomial, network=network)
    runs = run_campaign(simulator, design(beam, 8, 0), sensitivities=True, predictor=series)
    cached = emulator.cache()
    discrepancy = fit_discrepancy(beam, runs, series, lambda x: cached(beam.from_unit(x)))
    return replace(emulator, discrepancy=discrepancy)


THETAS = jnp.array([[0.1, 0.9], [0.5, 0.5], [1.0, 0.0], [0.3, 0.2]])
SUMS = [names for count in (0, 1, 2, len(NAMES)) for names in combinations(NAMES, count)]


def only(emulator, names):
    """The emulator with these parts alone."""
    return replace(emulator, **{name: None for name in NAMES if name not in names})


def test_the_parts_are_the_fields(whole):
    assert list(whole.parts) == list(NAMES)
    assert list(only(whole, ("network",)).parts) == ["network"]


def test_a_network_is_called_one(whole):
    assert whole.cache().label == "emulator"
    network = only(whole, ("network",))
    assert network.cache().label == "graph network"
    rest = constant(np.full(2, 0.5), whole.taylor.displacement)
    assert replace(network, taylor=rest).cache().label == "graph network"
    assert replace(network, taylor=whole.taylor).cache().label == "emulator"
    assert em.Emulator(whole.scene).cache().label == "emulator"


@pytest.mark.parametrize("names", SUMS, ids="+".join)
def test_cached_equals_uncached_whatever_the_parts(whole, beam, names):
    emulator = only(whole, names)
    cached = jax.jit(emulator.cache())
    for theta in beam.from_unit(THETAS):
        exact = emulator(theta)
        atol = 1e-5 * float(jnp.max(jnp.abs(exact)))
        np.testing.assert_allclose(cached(theta), exact, atol=atol, rtol=0)


def test_an_emulator_is_the_sum_of_its_parts(whole, beam):
    theta = beam.from_unit(THETAS[3])
    alone = [np.asarray(only(whole, (name,))(theta)) for name in NAMES]
    assert all(np.abs(one).max() > 1e-6 for one in alone)
    np.testing.assert_allclose(whole(theta), sum(alone), atol=1e-10)
    np.testing.assert_array_equal(Emulator(beam)(theta), beam.held_displacement)


def test_over_the_network_it_is_fem_at_its_runs(whole, beam, simulator):
    theta = design(beam, 8, 0)[4]  # a corner of the box, and a run
    error = jnp.abs(whole(theta) - simulator(theta)).max()
    bare = jnp.abs(replace(whole, discrepancy=None)(theta) - simulator(theta)).max()
    assert error < 1e-4 * bare


def test_a_batch_is_its_rows(whole, beam):
    cached = whole.cache()
    thetas = beam.from_unit(THETAS)
    together = cached(thetas)
    assert together.shape == (4, len(beam.mesh.nodes), 3)
    # The branch is float32, and its products depend on how many there are.
    np.testing.assert_allclose(together, jnp.stack([cached(t) for t in thetas]), atol=1e-8)
    np.testing.assert_allclose(jax.vmap(cached)(thetas), together, atol=1e-12)


def test_only_nodes_asked_for_are_decoded(whole, beam):
    nodes = np.array([44, 3])
    cached = whole.cache()
    theta = beam.from_unit(THETAS[0])
    np.testing.assert_allclose(cached.at(nodes)(theta), cached(theta)[nodes], atol=1e-12)
    np.testing.assert_allclose(whole.cache(nodes)(theta), cached(theta)[nodes], atol=1e-12)


def test_the_modes_of_all_parts_are_one_product(whole, beam):
    products = jax.make_jaxpr(whole.cache())(beam.centre).pretty_print().count("dot_general")
    alone = sum(
        jax.make_jaxpr(only(whole, (name,)).cache())(beam.centre)
        .pretty_print()
        .count("dot_general")
        for name in NAMES
    )
    assert products == alone - 3


def test_parts_that_are_absent_are_not_evaluated(whole, beam):
    def flops(*names):
        compiled = jax.jit(only(whole, names).cache()).lower(beam.centre).compile()
        return compiled.cost_analysis()["flops"]

    assert flops("discrepancy") < flops("taylor", "discrepancy") < flops(*NAMES)


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


def test_an_emulator_of_nothing_is_not_saved(beam, tmp_path):
    with pytest.raises(em.InputError, match="without any part has nothing to save"):
        save_emulator(Emulator(beam), tmp_path)


@pytest.mark.parametrize("names", SUMS[1:], ids="+".join)
def test_saved_and_loaded_it_is_the_same(whole, beam, tmp_path, names):
    emulator = only(whole, names)
    save_emulator(emulator, tmp_path)
    again = load(tmp_path, beam)
    assert again.fingerprint == emulator.fingerprint
    assert tuple(again.parts) == names
    np.testing.assert_array_equal(again(beam.centre), emulator(beam.centre))


def test_array_names_in_the_file_are_paths_of_the_parts(whole, tmp_path):
    save_emulator(whole, tmp_path)
    arrays, _ = read_arrays(tmp_path / "weights.safetensors")
    assert {name.split("/")[0] for name in arrays} == set(NAMES)
    assert {
        "taylor/derivatives",
        "network/weights/processor/rounds/0/edge/layers/1/kernel",
        "network/graph/senders",
        "discrepancy/modes",
        "discrepancy/warp/centre",
    } <= set(arrays)
    save_emulator(only(whole, ("taylor",)), tmp_path)
    arrays, _ = read_arrays(tmp_path / "weights.safetensors")
    assert {name.split("/")[0] for name in arrays} == {"taylor"}


def test_numbers_float32_can_hold_are_kept_in_half_the_room(whole, tmp_path):
    small = replace(whole, discrepancy=whole.discrepancy.rounded())
    save_emulator(small, tmp_path / "narrow")
    arrays, _ = read_arrays(tmp_path / "narrow" / "weights.safetensors")
    assert arrays["discrepancy/modes"].dtype == np.float32
    assert arrays["discrepancy/derivative_weights"].dtype == np.float64
    assert load(tmp_path / "narrow", whole.scene).fingerprint == small.fingerprint


def test_the_fingerprint_covers_the_scene_and_every_part(whole, beam):
    """Each change alone gives another: the scene, an array, the graph, an architecture."""
    network, series = whole.network, whole.taylor
    nudged = replace(series, displacement=series.displacement.at[3, 1].add(1e-12))
    graph = AugmentedGraph(
        **{**network.graph.arrays(), "edge_features": 1.5 * network.graph.edge_features},
        real=network.graph.real,
    )
    sizes = replace(network.architecture, decoder="pointwise")
    changed = [
        whole,
        replace(whole, scene=replace(beam, constants={}, origin={}, law=beam.law, loads=())),
        replace(whole, taylor=nudged),
        replace(whole, network=replace(network, scale=1.01 * network.scale)),
        replace(whole, network=replace(network, graph=graph)),
        replace(whole, network=replace(network, architecture=sizes)),
        *(only(whole, names) for names in SUMS if len(names) < 3),
    ]
    assert len({one.fingerprint for one in changed}) == len(changed)
    assert replace(whole, record={"note": 1}).fingerprint == whole.fingerprint


def test_an_untrained_network_adds_nothing_to_its_series(beam, simulator):
    series = expand(simulator, order=1)
    network = fresh(beam, augment(beam), SMALL, np.ones(3), 0)
    emulator = Emulator(beam, taylor=series, network=network)
    x = jnp.array([0.2, 0.6])
    expected = jnp.where(beam.held, 0.0, series(x))
    np.testing.assert_allclose(emulator(beam.from_unit(x)), expected, atol=1e-12)


def test_an_unknown_decoder_or_edge_sum():
    with pytest.raises(em.InputError, match="decoder 'dense': use pointwise or separable"):
        Architecture(decoder="dense")
    with pytest.raises(em.InputError, match="edge_sum 'all': use antisymmetric or receives"):
        Architecture(edge_sum="all")
    with pytest.raises(em.InputError, match="branch_activation 'step': use celu or swish"):
        Architecture(branch_activation="step")
