import numpy as np
import pytest

from emulator.errors import InputError
from emulator.geometry.discretisation import linear_tetrahedra
from emulator.geometry.generators import box
from emulator.geometry.mesh import Mesh, orient, signed_volumes

NODES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
GOOD = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])


def test_box_fills_its_volume_with_positive_elements():
    mesh = box((2.0, 3.0, 4.0), (2, 3, 1))
    volumes = signed_volumes(mesh.nodes, mesh.elements)
    assert len(mesh.elements) == 6 * 6
    assert volumes.min() > 0.0
    assert volumes.sum() == pytest.approx(24.0)
    np.testing.assert_array_equal(mesh.nodes[mesh.node_set("right"), 0], 2.0)
    assert len(mesh.node_set("top")) == 3 * 4


def test_orient_swaps_only_what_is_inverted():
    flipped = GOOD[:, [0, 2, 1, 3]]
    assert (signed_volumes(NODES, orient(NODES, flipped)) > 0).all()
    good = orient(NODES, GOOD)
    np.testing.assert_array_equal(orient(NODES, good), good)


@pytest.mark.parametrize(
    ("nodes", "elements", "message"),
    [
        (NODES, orient(NODES, GOOD)[:, [0, 2, 1, 3]], "element 0 has a negative volume"),
        (NODES * [1, 1, 0], GOOD, "element 0 has no volume, 2 such of 2"),
        (NODES, np.array([[0, 1, 2, 9]]), "elements name nodes 0..9"),
        (NODES, GOOD[:1], "node 4 belongs to no element"),
        (np.where(NODES == 1, np.nan, NODES), GOOD, "node 1 has a coordinate that is not finite"),
        (NODES[:, :2], GOOD, r"nodes have shape \(5, 2\)"),
        (NODES, GOOD[:, :3], r"elements have shape \(2, 3\)"),
    ],
)
def test_bad_meshes_are_named(nodes, elements, message):
    with pytest.raises(InputError, match=message):
        Mesh(nodes, elements)


def test_a_mesh_cannot_be_changed():
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1))
    with pytest.raises(ValueError, match="read-only"):
        mesh.nodes[0, 0] = 5.0
    with pytest.raises(TypeError):
        mesh.node_sets["new"] = np.array([0])


def test_missing_node_set_lists_the_others():
    with pytest.raises(
        InputError, match="node set 'apex' is not in the mesh; its sets: back, bottom"
    ):
        box((1.0, 1.0, 1.0), (1, 1, 1)).node_set("apex")


def test_shape_functions_sum_to_one_and_reproduce_linear_fields():
    mesh = box((2.0, 3.0, 4.0), (2, 2, 2))
    grid = linear_tetrahedra(mesh)
    np.testing.assert_allclose(grid.values.sum(axis=1), 1.0)
    np.testing.assert_allclose(grid.gradients.sum(axis=2), 0.0, atol=1e-13)
    assert grid.weights.sum() == pytest.approx(24.0)
    H = np.random.default_rng(0).normal(size=(3, 3))
    u = mesh.nodes @ H.T
    found = np.einsum("mai,mqaj->mqij", u[grid.connectivity], grid.gradients)
    np.testing.assert_allclose(found, np.broadcast_to(H, found.shape), atol=1e-12)
