from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import emulator as em
from emulator.core.errors import InputError
from emulator.surrogates import Architecture, Emulator, augment
from emulator.surrogates.network import fresh
from emulator.surrogates.network.graph import AugmentedGraph
from emulator.surrogates.network.pignn import MLP, PIGNN, Processor, antisymmetric_sum
from emulator.surrogates.taylor import constant
from network_support import SMALL, untrained


@pytest.fixture(scope="module")
def emulator(beam):
    return untrained(beam)


def test_the_published_sizes_have_the_published_number_of_weights():
    graph = augment(em.scenes.once_clamped_beam(order=1))
    network = PIGNN(Architecture(), graph, parameters=2, seed=0)
    count = sum(leaf.size for leaf in jax.tree.leaves(nnx.state(network)))
    assert count == pytest.approx(510_000, rel=0.005)


ACTIVATIONS = {
    "celu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),  # alpha is 1
    "swish": lambda x: x / (1.0 + np.exp(-x)),
}


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_an_mlp_of_parts_is_the_mlp_of_their_concatenation(name):
    mlp = MLP((3, 5), (7, 6), 4, layer_norm=True, activation=name, rngs=nnx.Rngs(0))
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.normal(size=(10, width)), jnp.float32) for width in (3, 5))
    x = np.hstack([a, b])
    for k, layer in enumerate(mlp.layers):
        x = x @ np.asarray(layer.kernel[...]) + np.asarray(layer.bias[...])
        if k < 2:
            x = ACTIVATIONS[name](x)
    x = (x - x.mean(axis=1, keepdims=True)) / np.sqrt(x.var(axis=1, keepdims=True) + 1e-6)
    np.testing.assert_allclose(mlp(a, b), x, atol=1e-5)


def test_messages_are_equal_and_opposite(beam):
    graph = augment(beam)
    messages = jnp.asarray(np.random.default_rng(0).normal(size=(len(graph.senders), 3)))
    received = antisymmetric_sum(messages, graph)
    np.testing.assert_allclose(received.sum(axis=0), 0.0, atol=1e-12)
    by_hand = np.zeros((len(graph.node_features), 3))
    for sender, receiver, message in zip(graph.senders, graph.receivers, messages, strict=True):
        by_hand[receiver] += message
        by_hand[sender] -= message
    np.testing.assert_allclose(received, by_hand, atol=1e-12)


def test_renumbering_the_nodes_renumbers_the_states(beam):
    graph = augment(beam)
    processor = Processor(SMALL, graph.node_features.shape[1], 4, nnx.Rngs(0))
    count = len(graph.node_features)
    new = np.random.default_rng(0).permutation(count)  # old node -> new node
    everything = replace(graph, real=count)
    renumbered = AugmentedGraph(
        node_features=graph.node_features[np.argsort(new)],
        edge_features=graph.edge_features,
        senders=new[graph.senders],
        receivers=new[graph.receivers],
        real=count,
    )
    states = jax.jit(lambda: (processor(renumbered), processor(everything)))
    after, before = map(np.asarray, states())
    np.testing.assert_allclose(after[new], before, atol=1e-4)


def test_an_untrained_emulator_is_its_offset(beam):
    offset = np.random.default_rng(0).normal(size=beam.held.shape)
    network = fresh(beam, augment(beam), SMALL, np.ones(3), 0)
    emulator = Emulator(beam, taylor=constant(np.full(2, 0.5), offset), network=network)
    expected, predict = np.where(beam.held, 0.0, offset), jax.jit(emulator)
    np.testing.assert_array_equal(predict(beam.centre), expected)
    np.testing.assert_array_equal(predict(beam.centre * 1.2), expected)


def test_held_values_are_exact(cube):
    u = jax.jit(untrained(cube))(cube.centre)
    np.testing.assert_array_equal(np.asarray(u)[cube.held], cube.held_displacement[cube.held])
    assert np.abs(np.asarray(u)[~cube.held]).min() > 0.0


def test_cached_equals_uncached_in_value_and_gradient(emulator, beam):
    cached = emulator.cache()
    weights = jnp.asarray(np.random.default_rng(0).normal(size=beam.held.shape))
    value, of_cached = (
        jax.jit(lambda t, f=f: (f(t), jax.grad(lambda t: jnp.vdot(weights, f(t)))(t)))
        for f in (emulator, cached)
    )
    for theta in beam.from_unit(jnp.array([[0.1, 0.9], [0.5, 0.5], [1.0, 0.0]])):
        (exact, a), (u, b) = value(theta), of_cached(theta)
        np.testing.assert_allclose(u, exact, atol=1e-6 * np.max(np.abs(exact)), rtol=0)
        # In float32, summed in another order: 1.06e-6 on one processor, less on others.
        np.testing.assert_allclose(a, b, atol=4e-6 * np.max(np.abs(b)), rtol=0)


def test_only_the_nodes_asked_for_are_decoded(emulator, beam):
    nodes = np.array([44, 3, 17])
    cached = emulator.cache()
    part = cached.at(nodes)
    np.testing.assert_allclose(part(beam.centre), cached(beam.centre)[nodes], atol=1e-6)
    work = lambda f: jax.jit(f).lower(beam.centre).compile().cost_analysis()["flops"]
    assert work(part) < 0.2 * work(cached)
    with pytest.raises(InputError, match="node 4 is not among the 3 this emulator map returns"):
        part.at(np.array([4]))
    with pytest.raises(InputError, match="node 45 is unknown; scene .* has nodes 0 to 44"):
        cached.at(np.array([45]))


@pytest.mark.parametrize("decoder", ["pointwise", "separable"])
def test_the_processor_is_traced_once(beam, monkeypatch, decoder):
    emulator = untrained(beam, architecture=replace(SMALL, decoder=decoder, modes=3))
    calls = []
    original = Processor.__call__
    monkeypatch.setattr(Processor, "__call__", lambda self, g: calls.append(1) or original(self, g))
    cached = emulator.cache()
    assert len(calls) == 1
    f = jax.jit(jax.value_and_grad(lambda t: jnp.sum(cached(t))))
    for theta in beam.from_unit(jnp.asarray(np.random.default_rng(0).uniform(size=(8, 2)))):
        f(theta)
        cached(theta)
    jax.vmap(cached)(jnp.stack([beam.centre] * 3))
    assert len(calls) == 1
    assert f._cache_size() == 1


def test_float32_weights_float64_answers(emulator, beam):
    assert {leaf.dtype for leaf in jax.tree.leaves(emulator.network.weights)} == {
        np.dtype("float32")
    }
    assert emulator.cache()(beam.centre).dtype == np.dtype("float64")


def test_outside_the_box_is_not_valid(emulator, beam):
    cached = emulator.cache()
    assert cached.evaluate(beam.centre).valid
    assert not cached.evaluate(beam.centre * 3.0).valid
    assert not cached.evaluate(jnp.array([jnp.nan, 60.0])).valid
    # Nothing that is not finite reaches a sampler from there, not even through a gradient.
    for theta in (jnp.array([-5.0, 60.0]), jnp.array([jnp.nan, 60.0])):
        f = lambda t: jnp.sum(cached.evaluate(t).displacement)
        assert np.isfinite(f(theta))
        assert np.isfinite(jax.grad(f)(theta)).all()


def test_the_shipped_emulator_cached_and_not():
    shipped = em.load("once_clamped_beam")
    cached = shipped.cache()
    theta = shipped.scene.theta(mu=57.0, lam=93.0)
    relative = lambda a, b: np.max(np.abs(a - b)) / np.max(np.abs(b))

    def both(forward):
        def value_slopes_and_gradient(t):
            gradient = jax.grad(lambda t: jnp.sum(forward(t) ** 2))(t)
            return forward(t), jax.jacfwd(forward)(t), gradient

        return jax.jit(value_slopes_and_gradient)(theta)

    (u, slopes, gradient), (v, others, other) = both(cached), both(shipped)
    assert relative(u, v) < 1e-6
    assert relative(slopes, others) < 1e-6
    np.testing.assert_allclose(gradient, other, rtol=1e-5)  # the network is of float32
