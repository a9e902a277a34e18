"""Meshes of scikit-fem, PyVista and meshio, taken as they are."""

from types import SimpleNamespace

import meshio
import numpy as np
import pytest
from skfem import MeshHex, MeshTet, MeshTet2

import emulator as em
from emulator.core.errors import InputError
from emulator.geometry.mesh import signed_volumes


@pytest.fixture
def block():
    """The unit cube, with one face named."""
    return MeshTet().refined(1).with_boundaries({"left": lambda x: x[0] == 0.0})


def grid_of(mesh, **data):
    """What a PyVista grid of these tetrahedra answers with."""
    types = np.full(len(mesh.elements), 10)
    return SimpleNamespace(
        points=mesh.nodes, celltypes=types, cells_dict={10: mesh.elements}, cell_data=data,
        point_data={"set:left": (mesh.nodes[:, 0] == 0.0).astype(float)},
    )  # fmt: skip


@pytest.mark.parametrize("kind", [MeshTet, MeshTet2])
def test_scikit_fem(block, kind):
    given = block if kind is MeshTet else MeshTet2.from_mesh(block)
    given = given.with_boundaries({"left": lambda x: x[0] == 0.0})
    mesh = em.read_mesh(given)
    assert mesh.order == (1 if kind is MeshTet else 2)
    assert signed_volumes(mesh.nodes, mesh.elements).sum() == pytest.approx(1.0)
    assert (mesh.nodes[mesh.facet_set("left")][..., 0] == 0.0).all()
    assert len(mesh.facet_set("left")) == len(given.boundaries["left"])
    # Nodes on edges lie halfway between the corners that Mesh says they do.
    if mesh.order == 2:
        halfway = mesh.nodes[mesh.elements[:, [0, 1]]].mean(axis=1)
        np.testing.assert_allclose(mesh.nodes[mesh.elements[:, 4]], halfway)


def test_there_and_back(block):
    mesh = em.read_mesh(block)
    np.testing.assert_array_equal(em.read_mesh(mesh.to_skfem()).elements, mesh.elements)


def test_a_grid_of_pyvista(block):
    mesh = em.read_mesh(block)
    fibres = np.tile([0.0, 0.6, 0.8], (len(mesh.elements), 1))
    body = em.read_body(grid_of(mesh, fibres=fibres))
    np.testing.assert_array_equal(body.mesh.elements, mesh.elements)
    np.testing.assert_allclose(body.fibres, fibres)
    np.testing.assert_array_equal(body.mesh.node_set("left"), mesh.node_set("left"))


def test_a_real_grid_of_pyvista(block):
    pyvista = pytest.importorskip("pyvista", reason="no pyvista here")
    mesh = em.read_mesh(block)
    grid = pyvista.UnstructuredGrid({10: mesh.elements}, mesh.nodes)
    grid.cell_data["fibres"] = np.tile([0.0, 0.6, 0.8], (len(mesh.elements), 1))
    body = em.read_body(grid)
    np.testing.assert_array_equal(body.mesh.elements, mesh.elements)
    np.testing.assert_allclose(body.fibres[0], [0.0, 0.6, 0.8])


def test_what_is_refused(block):
    with pytest.raises(InputError, match="a list is no mesh; give a file, a scikit-fem mesh"):
        em.read_mesh([1, 2])
    with pytest.raises(InputError, match="a scikit-fem MeshHex1 has no tetrahedra"):
        em.read_mesh(MeshHex())
    grid = grid_of(em.read_mesh(block))
    grid.celltypes = np.array([25])
    with pytest.raises(InputError, match=r"VTK's type 25; expected tetrahedra only"):
        em.read_mesh(grid)
    only_triangles = meshio.Mesh(np.eye(3), [("triangle", [[0, 1, 2]])])
    with pytest.raises(InputError, match=r"mesh \(Mesh\): it has no tetrahedra"):
        em.read_mesh(only_triangles)
