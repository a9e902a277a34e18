from dataclasses import replace

import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.discretisation import discretise
from emulator.geometry.generators.box import box, toward_ends
from emulator.geometry.mesh import Mesh, orient, parts, signed_volumes

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


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        (("left",), [0.0, 1 / 16, 4 / 16, 9 / 16, 1.0]),
        (("right",), [0.0, 7 / 16, 12 / 16, 15 / 16, 1.0]),
        (("left", "right"), [0.0, 1 / 8, 1 / 2, 7 / 8, 1.0]),
    ],
)
def test_cells_of_a_box_are_shorter_where_it_is_held(ends, expected):
    np.testing.assert_allclose(toward_ends(4, 2.0, ends), expected)
    mesh = box((10.0, 1.0, 1.0), (4, 1, 1), 2, toward_ends(4, 2.0, ends))
    corners = np.unique(mesh.nodes[np.unique(mesh.elements[:, :4]), 0])
    np.testing.assert_allclose(corners, 10.0 * np.array(expected))
    assert discretise(mesh).weights.sum() == pytest.approx(10.0)


def test_cells_that_are_longer_where_a_box_is_held_are_refused():
    with pytest.raises(InputError, match=r"grading of cells is 0\.5; expected 1 \(even\) or more"):
        toward_ends(4, 0.5, ("left",))


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


def test_facets_of_a_box_are_its_faces_pointing_out():
    mesh = box((2.0, 3.0, 4.0), (2, 3, 1))
    total = np.zeros(3)
    for name, direction, area in (
        ("left", [-1, 0, 0], 12.0), ("right", [1, 0, 0], 12.0), ("front", [0, -1, 0], 8.0),
        ("back", [0, 1, 0], 8.0), ("bottom", [0, 0, -1], 6.0), ("top", [0, 0, 1], 6.0),
    ):  # fmt: skip
        corner = mesh.nodes[mesh.facet_set(name)]
        normal = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).sum(
            axis=0
        )
        np.testing.assert_allclose(normal, area * np.array(direction), atol=1e-12)
        total += normal
    np.testing.assert_allclose(total, 0.0, atol=1e-12)


def test_facets_inside_the_body_are_refused():
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1))
    inside = np.array([[0, 7, 1]])  # along the diagonal all six tetrahedra share
    with pytest.raises(InputError, match=r"facet \[0, 1, 7\] of set 'cut' is not on the surface"):
        Mesh(mesh.nodes, mesh.elements, {}, {"cut": inside})
    with pytest.raises(InputError, match="facet set 'lid' is not in the mesh; its sets: back"):
        mesh.facet_set("lid")


def test_missing_node_set_lists_the_others():
    with pytest.raises(
        InputError, match="node set 'apex' is not in the mesh; its sets: back, bottom"
    ):
        box((1.0, 1.0, 1.0), (1, 1, 1)).node_set("apex")


def test_shape_functions_sum_to_one_and_reproduce_linear_fields():
    mesh = box((2.0, 3.0, 4.0), (2, 2, 2))
    grid = discretise(mesh)
    np.testing.assert_allclose(grid.values.sum(axis=1), 1.0)
    np.testing.assert_allclose(grid.gradients.sum(axis=2), 0.0, atol=1e-13)
    assert grid.weights.sum() == pytest.approx(24.0)
    H = np.random.default_rng(0).normal(size=(3, 3))
    u = mesh.nodes @ H.T
    found = np.einsum("mai,mqaj->mqij", u[grid.connectivity], grid.gradients)
    np.testing.assert_allclose(found, np.broadcast_to(H, found.shape), atol=1e-12)


def test_indices_with_a_fraction_are_not_cut_off():
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1))
    with pytest.raises(InputError, match="elements has numbers with a fraction"):
        replace(mesh, elements=mesh.elements + 0.7)
    assert replace(mesh, elements=mesh.elements.astype(float)).elements.dtype == np.int64


def test_tangled_elements_are_refused_though_every_volume_is_positive():
    """A corner pulled through the opposite face: its elements are inverted, then turned round."""
    mesh = box((3.0, 3.0, 3.0), (3, 3, 3))
    nodes = mesh.nodes.copy()
    inner = int(np.argmin(np.abs(nodes - 1.0).sum(axis=1)))
    nodes[inner] += 1.7
    elements = orient(nodes, mesh.elements)
    assert signed_volumes(nodes, elements).min() > 0.0
    assert (signed_volumes(nodes, mesh.elements) < 0.0).any()
    with pytest.raises(InputError, match=r"lie on the same side of the face .* mesh is tangled"):
        Mesh(nodes, elements)


def test_parts_of_a_body_are_told_apart():
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1))
    count = len(mesh.nodes)
    part = parts(np.concatenate([mesh.elements, mesh.elements + count]), 2 * count)
    np.testing.assert_array_equal(part, np.repeat([0, 1], count))
