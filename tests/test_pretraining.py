"""One network for several scenes (studies/transfer/pretraining.py)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies.transfer.pretraining import pretrain

import emulator as em
from emulator.core.errors import InputError
from emulator.training.checkpoint import Session
from emulator.training.graph_network import GraphNetwork
from emulator.training.network_plan import with_network_of
from emulator.training.plan import Job
from network_support import SMALL

FAMILY = GraphNetwork(objective="energy", steps=9, batch=2, checkpoint_every=4)


def same(a, b):
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(left, right)


def kill_after(writes, monkeypatch):
    """Stop a training after so many checkpoints."""
    write, written = Session.write, []

    def killed(*arguments):
        write(*arguments)
        written.append(arguments)
        if len(written) == writes:
            raise KeyboardInterrupt

    monkeypatch.setattr(Session, "write", killed)


@pytest.fixture(scope="module")
def other():
    """The beam on a mesh of another topology."""
    return em.scenes.once_clamped_beam(cells=(3, 3, 2), order=1)


@pytest.fixture(scope="module")
def own(other):
    """What training the other beam afresh works on."""
    return FAMILY.prepare(Job(other, SMALL))


@pytest.fixture(scope="module")
def pretrained(beam, other, tmp_path_factory):
    folder = tmp_path_factory.mktemp("family")
    return pretrain([beam, other], FAMILY, folder, architecture=SMALL)


@pytest.mark.slow
def test_a_family_shares_one_network(beam, other, own, pretrained):
    same(pretrained[0].network.weights, pretrained[1].network.weights)
    assert [e.scene for e in pretrained] == [beam, other]
    np.testing.assert_array_equal(pretrained[1].network.scale, own.emulator.network.scale)
    same(pretrained[1].network.graph.edge_features, own.emulator.network.graph.edge_features)
    assert pretrained[0].record["family"] == [beam.fingerprint, other.fingerprint]


@pytest.mark.slow
def test_a_family_takes_its_scenes_in_turn(beam, own, pretrained):
    problems = [FAMILY.prepare(Job(beam, SMALL)), own]
    weights = with_network_of(problems[0].emulator, problems[1].emulator).network.weights
    state = problems[0].training.optimiser.init(weights)
    for number in range(FAMILY.steps):
        weights, state, _ = problems[number % 2].training.step(
            weights, state, jnp.asarray(number), jnp.asarray(FAMILY.steps)
        )
    same(weights, pretrained[0].network.weights)


@pytest.mark.slow
def test_a_family_killed_resumes_to_the_same(beam, other, pretrained, tmp_path, monkeypatch):
    scenes = [beam, other]
    with monkeypatch.context() as patch:
        kill_after(2, patch)
        with pytest.raises(KeyboardInterrupt):
            pretrain(scenes, FAMILY, tmp_path, architecture=SMALL)
    resumed = pretrain(scenes, GraphNetwork(), tmp_path, resume=True)
    same(resumed[0].network.weights, pretrained[0].network.weights)
    with pytest.raises(InputError, match="belongs to another scene"):
        pretrain(scenes[::-1], FAMILY, tmp_path, resume=True)


def test_families_that_cannot_be(beam, cube, tmp_path):
    with pytest.raises(InputError, match="no scene is given"):
        pretrain([], FAMILY, tmp_path)
    with pytest.raises(InputError, match="'twisting_cube' has E, nu"):
        pretrain([beam, cube], FAMILY, tmp_path, architecture=SMALL)
