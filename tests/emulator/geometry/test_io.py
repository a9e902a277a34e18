import meshio
import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.generators.box import box
from emulator.geometry.io import (
    read_body,
    read_cells,
    read_mesh,
    write_mesh,
    write_solution,
)
from emulator.geometry.mesh import Mesh, signed_volumes

# Two tetrahedra on the base z = 0; tip, lid and far end on top. Node 5 is an arc's centre.
NODES = """$Nodes
6
1 0 0 0
2 1 0 0
3 0 1 0
4 0 0 1
5 9 9 9
6 1 1 1
$EndNodes
"""
NAMES = """$PhysicalNames
4
0 4 "tip"
1 3 "edge"
2 7 "base"
3 1 "tissue"
$EndPhysicalNames
"""
# number, type, two tags (physical, geometrical), nodes: point 15, line 1, triangle 2, tetra 4
CELLS = """$Elements
6
1 15 2 4 1 4
2 1 2 3 1 1 2
3 2 2 7 1 1 2 3
4 2 2 0 2 1 3 4
5 4 2 1 1 1 2 3 4
6 4 2 1 1 2 3 4 6
$EndElements
"""
MSH2 = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n" + NAMES + NODES + CELLS
# The same body with the groups on entities: point 1, curve 1, surfaces 1 and 2, volume 1.
MSH4 = (
    "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n"
    + NAMES
    + """$Entities
1 1 2 1
1 0 0 1 1 4
1 0 0 0 1 0 0 1 3 0
1 0 0 0 1 1 0 2 7 8 0
2 0 0 0 0 1 1 1 8 0
1 0 0 0 1 1 1 1 1 0
$EndEntities
$Nodes
1 6 1 6
3 1 0 6
1
2
3
4
5
6
0 0 0
1 0 0
0 1 0
0 0 1
9 9 9
1 1 1
$EndNodes
$Elements
5 6 1 6
0 1 15 1
1 4
1 1 1 1
2 1 2
2 1 2 1
3 1 2 3
2 2 2 1
4 1 3 4
3 1 4 2
5 1 2 3 4
6 2 3 4 6
$EndElements
"""
).replace("4\n0 4", '5\n2 8 "outside"\n0 4')


def gmsh(folder, text):
    path = folder / "body.msh"
    path.write_text(text)
    return path


def outward(mesh, facets):
    """Whether each facet's normal points away from the element behind it."""
    corner = mesh.nodes[facets[:, :3]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inside = mesh.nodes[mesh.elements[mesh.elements_behind(facets)]].mean(axis=1)
    return np.einsum("ki,ki->k", normal, corner[:, 0] - inside) > 0.0


def same(sets, expected):
    """Equal sets of nodes, or of facets, whatever the order."""
    assert sorted(sets) == sorted(expected)
    for name in sets:
        rows = (np.sort(np.atleast_2d(a[name]), axis=1).tolist() for a in (sets, expected))
        first, second = map(sorted, rows)
        assert first == second, name


def test_physical_groups_of_gmsh_2_become_sets(tmp_path):
    mesh = read_mesh(gmsh(tmp_path, MSH2))
    assert len(mesh.nodes) == 5  # the arc's centre is gone, and (1, 1, 1) moved up
    np.testing.assert_array_equal(mesh.nodes[4], [1.0, 1.0, 1.0])
    same(mesh.node_sets, {"tip": np.array([3]), "edge": np.array([0, 1]), "base": np.arange(3)})
    same(mesh.facet_sets, {"base": np.array([[0, 1, 2]])})
    assert outward(mesh, mesh.facet_set("base")).all()


def test_physical_groups_of_gmsh_4_become_sets(tmp_path):
    mesh = read_mesh(gmsh(tmp_path, MSH4))
    assert len(mesh.nodes) == 5
    # Surface 1 is in two groups, as gmsh allows.
    base, side = [0, 1, 2], [0, 2, 3]
    same(mesh.facet_sets, {"base": np.array([base]), "outside": np.array([base, side])})
    np.testing.assert_array_equal(mesh.node_set("outside"), [0, 1, 2, 3])
    np.testing.assert_array_equal(mesh.node_set("tip"), [3])
    assert outward(mesh, mesh.facet_set("outside")).all()


def test_inverted_tetrahedra_are_turned(tmp_path):
    turned = read_mesh(gmsh(tmp_path, MSH2.replace("1 1 1 2 3 4", "1 1 1 3 2 4")))
    assert (signed_volumes(turned.nodes, turned.elements) > 0.0).all()
    assert outward(turned, turned.facet_set("base")).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '2 7 "base"',
            '2 9 "base"',
            r"body.msh: physical group 7 \(triangles\) has no name .*\$PhysicalNames",
        ),
        ('1 3 "edge"', '1 9 "edge"', r"physical group 3 \(lines\) has no name"),
        ('0 4 "tip"', '0 9 "tip"', r"physical group 4 \(points\) has no name"),
        ("3 2 2 7 1 1 2 3\n", "3 2 2 7 1 2 3 4\n", "1 of the 1 triangles in group 'base' are not"),
        ("3 2 2 7 1 1 2 3\n", "3 2 2 7 1 1 2 5\n", "1 of the 1 triangles in group 'base' are not"),
        ("6 4 2 1 1 2 3 4 6", "6 3 2 1 1 1 2 3 4", "it has quad cells; expected tetrahedra"),
        (
            "5 4 2 1 1 1 2 3 4\n6 4 2 1 1 2 3 4 6",
            "5 2 2 7 1 1 2 3\n6 2 2 7 1 1 2 3",
            "no tetrahedra, only line, triangle, vertex; mesh the volume",
        ),
        ("6 4 2 1 1 2 3 4 6", "6 4 2 1 1 2 3 4 4", "element 1 has no volume"),
    ],
)
def test_one_line_for_every_mistake(tmp_path, capsys, old, new, message):
    assert old in MSH2
    with pytest.raises(InputError, match=message) as caught:
        read_mesh(gmsh(tmp_path, MSH2.replace(old, new)))
    assert "\n" not in str(caught.value)
    assert capsys.readouterr() == ("", "")


def test_a_mesh_without_groups_is_fine(tmp_path):
    bare = MSH2.replace(NAMES, "").replace(" 2 7 1 ", " 2 0 1 ")
    bare = bare.replace(" 2 3 1 ", " 2 0 1 ").replace(" 2 4 1 ", " 2 0 1 ")
    mesh = read_mesh(gmsh(tmp_path, bare))
    assert not mesh.node_sets
    assert not mesh.facet_sets


def test_sets_of_abaqus(tmp_path):
    path = tmp_path / "body.inp"
    path.write_text(
        "*NODE\n1, 0,0,0\n2, 1,0,0\n3, 0,1,0\n4, 0,0,1\n5, 9,9,9\n"
        "*ELEMENT, TYPE=C3D4\n1, 1,2,3,4\n"
        "*NSET, NSET=base\n1,2,3\n"
    )
    mesh = read_mesh(path)
    assert len(mesh.nodes) == 4
    same(mesh.node_sets, {"base": np.arange(3)})


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".xdmf"])
def test_what_is_written_reads_back(tmp_path, suffix):
    plain = box((1.0, 2.0, 3.0), (1, 2, 2))
    low = np.concatenate([plain.facet_set("left"), plain.facet_set("bottom")])  # shared facets
    mesh = Mesh(
        plain.nodes / 3.0,  # coordinates that need every digit
        plain.elements,
        {**plain.node_sets, "low": np.unique(low), "corner": np.array([0, 5])},
        {**plain.facet_sets, "low": low},
    )
    rng = np.random.default_rng(0)
    fibres, sheets = rng.normal(size=(2, len(mesh.elements), 3))
    fibres /= np.linalg.norm(fibres, axis=1, keepdims=True)
    sheets /= np.linalg.norm(sheets, axis=1, keepdims=True)
    path = tmp_path / f"body{suffix}"
    write_mesh(path, mesh, *((fibres, sheets) if suffix != ".msh" else ()))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    body = read_body(path)
    np.testing.assert_allclose(body.mesh.nodes, mesh.nodes, rtol=1e-15)
    np.testing.assert_array_equal(body.mesh.elements, mesh.elements)
    same(body.mesh.node_sets, mesh.node_sets)
    same(body.mesh.facet_sets, mesh.facet_sets)
    for name, facets in body.mesh.facet_sets.items():
        assert outward(body.mesh, facets).all(), name
    if suffix == ".msh":
        assert body.fibres is body.sheets is None
        return
    np.testing.assert_allclose(body.fibres, fibres, rtol=1e-12)
    np.testing.assert_allclose(body.sheets, sheets, rtol=1e-12)


def test_a_mesh_without_sets_or_fibres_reads_back(tmp_path):
    plain = box((1.0, 1.0, 1.0), (1, 1, 1))
    for suffix in (".msh", ".vtu", ".xdmf"):
        path = tmp_path / f"bare{suffix}"
        write_mesh(path, Mesh(plain.nodes, plain.elements))
        body = read_body(path)
        assert body.fibres is None
        assert not body.mesh.node_sets


def test_a_file_that_cannot_hold_the_sets_is_refused(tmp_path):
    plain = box((1.0, 1.0, 1.0), (1, 1, 1))
    mixed = Mesh(
        plain.nodes,
        plain.elements,
        {"left": np.array([0])},
        {"left": plain.facet_set("left")},
    )
    with pytest.raises(InputError, match="facet set 'left' and node set 'left' have different"):
        write_mesh(tmp_path / "body.msh", mixed)
    with pytest.raises(InputError, match=".msh cannot hold fibres; use .vtu"):
        write_mesh(tmp_path / "body.msh", plain, np.ones((6, 3)))
    with pytest.raises(InputError, match="cannot write '.stl'; use .msh"):
        write_mesh(tmp_path / "body.stl", plain)
    assert not list(tmp_path.iterdir())
    write_mesh(tmp_path / "body.vtu", mixed)
    np.testing.assert_array_equal(read_mesh(tmp_path / "body.vtu").node_set("left"), [0])


def with_data(path, **data):
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1))
    meshio.write(path, meshio.Mesh(mesh.nodes, [("tetra", mesh.elements)], **data))
    return path


def test_fibres_at_nodes_are_averaged_whatever_their_sign(tmp_path):
    fibres = np.tile([0.6, 0.8, 0.0], (8, 1)) * np.array([1, -1, 1, 1, -1, -1, 1, 1])[:, None]
    path = with_data(tmp_path / "body.vtu", point_data={"fibres": fibres})
    found = read_body(path).fibres
    assert found.shape == (6, 3)
    np.testing.assert_allclose(np.abs(found @ [0.6, 0.8, 0.0]), 1.0, rtol=1e-14)


def test_fibres_that_are_not_unit_vectors_are_named(tmp_path):
    fibres = np.tile([1.0, 0.0, 0.0], (6, 1))
    fibres[3] *= 0.5
    path = with_data(tmp_path / "long.vtu", cell_data={"fibres": [fibres]})
    with pytest.raises(InputError, match="'fibres' at element 3 has length 0.5, 1 such of 6"):
        read_body(path)
    assert len(read_mesh(path).elements) == 6  # who asks for no fibres is not told
    path = with_data(tmp_path / "nan.vtu", point_data={"sheets": np.full((8, 3), np.nan)})
    with pytest.raises(InputError, match="'sheets' at node 0 has length nan, 8 such of 8"):
        read_body(path)
    path = with_data(tmp_path / "flat.vtu", cell_data={"fibres": [np.ones(6)]})
    with pytest.raises(InputError, match=r"'fibres' have shape \(6,\); expected 3 components"):
        read_body(path)


def test_a_written_solution_reads_back(tmp_path):
    mesh = box((1.0, 2.0, 3.0), (1, 2, 2))
    rng = np.random.default_rng(0)
    u, stress = rng.normal(size=mesh.nodes.shape), rng.normal(size=(len(mesh.elements), 3, 3))
    path = tmp_path / "body.vtu"
    J = np.arange(len(mesh.elements), dtype=float)
    write_solution(path, mesh, u, {"J": J, "cauchy_stress": stress})
    back = read_mesh(path)
    np.testing.assert_allclose(back.nodes, mesh.nodes)
    np.testing.assert_array_equal(back.elements, mesh.elements)
    content = meshio.read(path)
    np.testing.assert_allclose(content.point_data["displacement"], u)
    np.testing.assert_allclose(content.cell_data["J"][0], J)
    np.testing.assert_allclose(content.cell_data["cauchy_stress"][0].reshape(-1, 3, 3), stress)
    assert [file.name for file in tmp_path.iterdir()] == ["body.vtu"]


def test_nothing_half_written(tmp_path):
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1))
    with pytest.raises(ValueError, match=r"len\(point"):
        write_solution(tmp_path / "body.vtu", mesh, np.zeros((3, 3)))
    assert not list(tmp_path.iterdir())


def test_a_reader_that_refuses_a_file_leaves_other_output_alone(tmp_path, capsys, monkeypatch):
    """meshio prints the reason and exits; what other threads print meanwhile is theirs."""

    def refuse(path):
        print("another thread's line")
        raise meshio.ReadError("no facets")

    monkeypatch.setitem(meshio._helpers.reader_map, "stl", refuse)
    (tmp_path / "wall.stl").write_text("solid")
    with pytest.raises(InputError, match="cannot be read as a mesh: not valid stl: no facets$"):
        read_cells(tmp_path / "wall.stl")
    assert capsys.readouterr() == ("another thread's line\n", "")


def test_unusable_mesh_files_are_named(tmp_path, capsys):
    with pytest.raises(InputError, match="does not exist"):
        read_mesh(tmp_path / "none.vtu")
    (tmp_path / "broken.vtu").write_text("<not xml")
    with pytest.raises(InputError, match="cannot be read as a mesh"):
        read_mesh(tmp_path / "broken.vtu")
    (tmp_path / "broken.vtk").write_text("nonsense")
    with pytest.raises(InputError, match="cannot be read as a mesh: .*header"):
        read_mesh(tmp_path / "broken.vtk")
    assert capsys.readouterr() == ("", "")


def test_nodes_at_the_same_place_are_refused(tmp_path):
    """Two blocks that touch, each with nodes of its own."""
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1))
    count = len(mesh.nodes)
    points = np.concatenate([mesh.nodes, mesh.nodes + [1.0, 0.0, 0.0]])
    cells = np.concatenate([mesh.elements, mesh.elements + count])
    meshio.Mesh(points, [("tetra", cells)]).write(tmp_path / "two.vtu")
    with pytest.raises(InputError, match=r"are at the same place, 4 such pairs.*merge them"):
        read_mesh(tmp_path / "two.vtu")
