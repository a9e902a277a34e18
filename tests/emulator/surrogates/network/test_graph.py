from dataclasses import replace

import numpy as np

import emulator as em
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_quadratic
from emulator.scenes import Scene, Support
from emulator.surrogates.network.graph import augment, mesh_edges


def test_real_edges_are_those_of_the_tetrahedra():
    edges = mesh_edges(np.array([[0, 1, 2, 3], [1, 2, 3, 4]]))
    assert len(edges) == 9
    assert {tuple(edge) for edge in edges} == {
        (0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3), (1, 4), (2, 4), (3, 4)
    }  # fmt: skip


def test_edges_of_a_quadratic_tetrahedron_go_through_their_middle():
    assert {tuple(edge) for edge in mesh_edges(np.arange(10)[None])} == {
        (0, 4), (1, 4), (1, 5), (2, 5), (0, 6), (2, 6), (0, 7), (3, 7), (1, 8), (3, 8), (2, 9), (3, 9)
    }  # fmt: skip


def test_mid_side_nodes_are_nodes_of_the_graph_joined_to_the_ends_of_their_edge(beam):
    mesh = to_quadratic(beam.mesh)
    graph = augment(replace(beam, mesh=mesh, origin={}))
    corners = len(beam.mesh.nodes)
    assert graph.real == len(mesh.nodes) > 4 * corners
    within = (graph.senders < graph.real) & (graph.receivers < graph.real)
    pairs = np.sort(np.column_stack([graph.senders, graph.receivers])[within], axis=1)
    # Corners meet mid-side nodes only, two corners each, which lie at equal distances.
    assert (pairs[:, 0] < corners).all()
    assert (pairs[:, 1] >= corners).all()
    nodes, counts = np.unique(pairs[:, 1], return_counts=True)
    assert len(nodes) == len(mesh.nodes) - corners
    assert (counts == 2).all()
    ends = pairs[np.argsort(pairs[:, 1], kind="stable"), 0].reshape(-1, 2)
    np.testing.assert_allclose(mesh.nodes[ends].mean(axis=1), mesh.nodes[nodes], atol=1e-12)


def test_every_node_reaches_every_other_in_few_steps():
    scene = em.scenes.once_clamped_beam(order=1)
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
    graph = augment(em.scenes.once_clamped_beam(cells=(4, 2, 2), order=1))
    for features in (graph.node_features, graph.edge_features):
        np.testing.assert_allclose(features.mean(axis=0), 0.0, atol=1e-5)
        sd = features.std(axis=0)
        assert ((np.abs(sd - 1.0) < 1e-4) | (sd == 0.0)).all()


def test_moving_the_body_changes_nothing():
    scene = em.scenes.once_clamped_beam(cells=(4, 2, 2), order=1)
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


def test_tiny_bodies_have_no_virtual_nodes():
    graph = augment(em.scenes.once_clamped_beam(cells=(1, 1, 1), order=1))
    assert len(graph.node_features) == graph.real == 8
