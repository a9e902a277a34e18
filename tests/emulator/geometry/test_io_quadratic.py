import meshio
import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.generators.box import box
from emulator.geometry.io import read_body, read_mesh, write_mesh, write_solution
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_quadratic

EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
MESH = to_quadratic(box((1.0, 2.0, 3.0), (1, 2, 2)))


def rows(facets):
    return sorted(np.sort(facets, axis=1).tolist())


@pytest.mark.parametrize("suffix", [".msh", ".vtu"])
def test_quadratic_meshes_read_back(tmp_path, suffix):
    path = tmp_path / f"body{suffix}"
    write_mesh(path, MESH)
    back = read_mesh(path)
    np.testing.assert_array_equal(back.elements, MESH.elements)
    np.testing.assert_allclose(back.nodes, MESH.nodes)
    assert set(back.facet_sets) == set(MESH.facet_sets)
    for name, facets in MESH.facet_sets.items():
        assert back.facet_set(name).shape == facets.shape
        assert rows(back.facet_set(name)) == rows(facets)
        np.testing.assert_array_equal(back.node_set(name), np.sort(MESH.node_set(name)))


def test_inverted_quadratic_tetrahedra_are_turned(tmp_path):
    mirrored = MESH.elements[:, [1, 0, 2, 3, 4, 6, 5, 8, 7, 9]]
    meshio.write(tmp_path / "body.vtu", meshio.Mesh(MESH.nodes, [("tetra10", mirrored)]))
    back = read_mesh(tmp_path / "body.vtu")
    for k, (a, b) in enumerate(EDGES):
        ends = back.nodes[back.elements[:, [a, b]]]
        np.testing.assert_allclose(back.nodes[back.elements[:, 4 + k]], ends.mean(axis=1))


def test_fibres_and_solutions_of_quadratic_meshes(tmp_path):
    fibres = np.tile([1.0, 0.0, 0.0], (len(MESH.elements), 1))
    write_solution(tmp_path / "body.vtu", MESH, np.zeros_like(MESH.nodes), {"fibres": fibres})
    body = read_body(tmp_path / "body.vtu")
    np.testing.assert_array_equal(body.mesh.elements, MESH.elements)
    # One direction an element is that of its four points.
    np.testing.assert_allclose(body.fibres, np.tile(fibres[:, None], (1, 4, 1)), atol=1e-15)


def test_xdmf_holds_no_quadratic_facets(tmp_path):
    with pytest.raises(InputError, match=r"\.xdmf cannot hold quadratic facet sets; use \.vtu"):
        write_mesh(tmp_path / "body.xdmf", MESH)
    write_mesh(tmp_path / "body.xdmf", Mesh(MESH.nodes, MESH.elements))
    np.testing.assert_array_equal(read_mesh(tmp_path / "body.xdmf").elements, MESH.elements)
