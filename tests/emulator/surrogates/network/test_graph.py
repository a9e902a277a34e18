import numpy as np
import pytest

import emulator as em
from emulator.geometry.mesh import Mesh
from emulator.scenes import Scene, Support
from emulator.surrogates.network.graph import GraphOptions, augment, mesh_edges


def test_real_edges_are_those_of_the_tetrahedra():
    edges = mesh_edges(np.array([[0, 1, 2, 3], [1, 2, 3, 4]]))
    assert len(edges) == 9
    assert {tuple(edge) for edge in edges} == {
        (0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3), (1, 4), (2, 4), (3, 4)
    }  # fmt: skip


def test_every_node_reaches_every_other_in_few_steps():
    scene = em.scenes.once_clamped_beam()
    graph = augment(scene)
    count = len(graph.node_features)
    assert graph.real == 390
    assert count == 390 + 97 + 24  # a quarter each time, until fewer than 8
    assert (graph.senders > graph.receivers).all()
    assert len(np.unique(np.stack([graph.senders, graph.receivers]), axis=1).T) == len(
        graph.senders
    )
    reach = np.eye(count, dtype=bool)
    step = np.eye(count, dtype=bool)
    step[graph.senders, graph.receivers] = step[graph.receivers, graph.senders] = True
    for _ in range(5):
        reach = reach @ step
    assert reach.all()
    # Mesh edges alone do not: 12 cells lie between the ends.
    real = step[:390, :390]
    assert not np.linalg.matrix_power(real.astype(np.int64), 5).all()


def test_features_are_normalised_and_constant_columns_zero():
    graph = augment(em.scenes.once_clamped_beam(cells=(4, 2, 2)))
    for features in (graph.node_features, graph.edge_features):
        np.testing.assert_allclose(features.mean(axis=0), 0.0, atol=1e-5)
        spread = features.std(axis=0)
        assert ((np.abs(spread - 1.0) < 1e-4) | (spread == 0.0)).all()


def test_moving_the_body_changes_nothing():
    scene = em.scenes.once_clamped_beam(cells=(4, 2, 2))
    mesh = scene.mesh
    moved = Scene(
        name="moved",
        mesh=Mesh(mesh.nodes + [5.0, -3.0, 11.0], mesh.elements, mesh.node_sets),
        law=scene.law,
        parameters=scene.parameters,
        loads=scene.loads,
        supports=(Support("left"),),
    )
    here, there = augment(scene), augment(moved)
    np.testing.assert_array_equal(here.senders, there.senders)
    np.testing.assert_allclose(here.node_features, there.node_features, atol=1e-5)
    np.testing.assert_allclose(here.edge_features, there.edge_features, atol=1e-5)


@pytest.mark.parametrize("neighbours", [2, 6])
def test_tiny_bodies_have_no_virtual_nodes(neighbours):
    graph = augment(
        em.scenes.once_clamped_beam(cells=(1, 1, 1)), GraphOptions(neighbours=neighbours)
    )
    assert len(graph.node_features) == graph.real == 8
