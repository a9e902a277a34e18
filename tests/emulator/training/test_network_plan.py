"""Starting from another emulator's network."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.surrogates import load, save_emulator
from emulator.training import recipe, train
from emulator.training.checkpoint import CHECKPOINT, Session
from emulator.training.graph_network import GraphNetwork
from emulator.training.plan import Job
from network_support import SMALL, untrained

PLAN = GraphNetwork(objective="energy", steps=12, batch=2, checkpoint_every=5)


def same(a, b):
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(left, right)


@pytest.fixture(scope="module")
def other():
    """The beam on a mesh of another topology."""
    return em.scenes.once_clamped_beam(cells=(3, 3, 2), order=1)


@pytest.fixture(scope="module")
def start(beam):
    return untrained(beam)


@pytest.fixture(scope="module")
def own(other):
    """What training the other beam afresh works on."""
    return PLAN.prepare(Job(other, SMALL))


@pytest.fixture(scope="module")
def whole(other, start, tmp_path_factory):
    return train(other, PLAN, tmp_path_factory.mktemp("whole"), start=start)


def kill_after(writes, monkeypatch):
    """Stop a training after so many checkpoints."""
    write, kept = Session.write, []

    def killed(*arguments):
        write(*arguments)
        kept.append(arguments)
        if len(kept) == writes:
            raise KeyboardInterrupt

    monkeypatch.setattr(Session, "write", killed)


@pytest.mark.slow
def test_before_any_step_the_network_is_the_other_ones(other, own, start):
    problem = PLAN.prepare(Job(other, start=start))
    emulator, own = problem.emulator, own.emulator
    network = emulator.network
    same(network.weights, start.network.weights)
    assert network.architecture == SMALL
    np.testing.assert_array_equal(network.scale, own.network.scale)
    np.testing.assert_array_equal(emulator.taylor.displacement, own.taylor.displacement)
    # The prediction by hand: the old network on the new graph, in the new scale, on the new series.
    theta = other.theta(mu=60.0, lam=70.0)
    decoder, prepared = own.network.prepare(start.network.weights)
    raw = np.asarray(decoder(prepared, own.network.normalise(other.to_unit(theta))), dtype=float)
    expected = np.asarray(own.taylor.displacement) + own.network.scale * raw
    expected[other.held] = other.held_displacement[other.held]
    np.testing.assert_allclose(emulator(theta), expected, atol=1e-7)
    assert np.abs(emulator(theta) - own(theta)).max() > 1e-3


@pytest.mark.slow
def test_training_leaves_the_emulator_it_started_from(whole, start, beam):
    # A step consumes the weights it is given; these were a copy.
    same(start.network.weights, untrained(beam).network.weights)
    pairs = [jax.tree.leaves(e.network.weights) for e in (whole, start)]
    assert any((a != b).any() for a, b in zip(*pairs, strict=True))


@pytest.mark.slow
def test_where_a_training_started_is_recorded(whole, start, tmp_path):
    assert whole.record["start"] == {
        "scene": "once_clamped_beam",
        "scene_fingerprint": start.scene.fingerprint,
        "fingerprint": start.fingerprint,
    }
    save_emulator(whole, tmp_path / "e")
    assert load(tmp_path / "e").record["start"]["fingerprint"] == start.fingerprint


@pytest.mark.slow
@pytest.mark.parametrize("writes", [1, 2])
def test_a_started_run_killed_resumes_without_its_start(
    other, start, whole, tmp_path, monkeypatch, writes
):
    with monkeypatch.context() as patch:
        kill_after(writes, patch)
        with pytest.raises(KeyboardInterrupt):
            train(other, PLAN, tmp_path, start=start)
    with pytest.raises(InputError, match="has its network's weights; resume it without a start"):
        train(other, GraphNetwork(), tmp_path, start=start, resume=True)
    # Neither the start nor its architecture is said again.
    resumed = train(other, GraphNetwork(), tmp_path, resume=True)
    same(resumed.network.weights, whole.network.weights)
    assert resumed.record["start"] == whole.record["start"]


def test_what_cannot_be_started_from(beam, other, cube, start, tmp_path):
    def refused(scene, plan, message, architecture=None, start=start):
        with pytest.raises(InputError, match=message) as error:
            train(scene, plan, tmp_path, architecture=architecture, start=start)
        assert "\n" not in str(error.value)

    wider = replace(SMALL, latent=9)
    refused(other, PLAN, r"has a network .*latent=8.*; 'once_clamped_beam' .*latent=9", wider)
    refused(other, replace(PLAN, decoder="separable"), "decoder='pointwise'.*'separable'")
    refused(cube, PLAN, "'once_clamped_beam' has parameters mu, lam; 'twisting_cube' has")
    refused(other, recipe("hybrid"), "modes mean nothing on another")
    nothing = "'once_clamped_beam' has no network to start from, only taylor . discrepancy"
    refused(other, PLAN, nothing, start=em.load("once_clamped_beam"))
    refused(other, recipe("mechanics"), "recipe 'mechanics' trains no network")
    for name in ("mechanics", "two_meshes", "family", "sweeps"):
        message = f"recipe '{name}' trains no network, so no architecture"
        refused(other, recipe(name), message, SMALL, None)
    clamped = em.Support("right", np.array([0.0, 0.0, -0.1]))
    moved = replace(other, supports=(*other.supports, clamped))
    refused(moved, PLAN, "has 6 features a node, 'once_clamped_beam' has 9")
    assert not (tmp_path / CHECKPOINT).exists()
