"""Mesh files as other programs write them: by hand, and by meshio."""

import base64
import json
import struct

import meshio
import numpy as np
import pytest

from calibrate.cli import main
from cli_support import answer, complaint
from emulator.core.errors import InputError
from emulator.geometry.generators.box import box
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.io import read_body, read_mesh, read_regions
from emulator.geometry.refinement import to_quadratic
from emulator.hearts.surfaces import read_surface

BLOCK = box((20.0, 10.0, 10.0), (4, 2, 2))
SIDES = np.concatenate([BLOCK.facet_set(name) for name in ("left", "right", "top")])
TAGS = np.repeat([1, 2, 3], [len(BLOCK.facet_set(name)) for name in ("left", "right", "top")])
REGIONS = np.where(BLOCK.nodes[BLOCK.elements].mean(axis=1)[:, 0] < 10.0, 1, 2)


def tagged(name, tags=TAGS, regions=REGIONS):
    return meshio.Mesh(
        BLOCK.nodes,
        [("triangle", SIDES), ("tetra", BLOCK.elements)],
        cell_data={name: [tags, regions]},
    )


def gmsh22(path):
    content = tagged("gmsh:physical")
    content.cell_data["gmsh:geometrical"] = content.cell_data["gmsh:physical"]
    meshio.write(path, content, file_format="gmsh22", binary=path.name.startswith("binary"))


def med(path):
    content = tagged("cell_tags", -TAGS, -5 - REGIONS)
    content.cell_tags = {-1: ["1", "walls"], -2: ["2", "walls"], -3: ["3"], -6: ["a"], -7: ["b"]}
    content.point_tags = {}
    meshio.write(path, content)


WRITERS = {
    "dolfin.xdmf": lambda path: meshio.write(path, tagged("name_to_read")),
    "ascii.msh": gmsh22,
    "binary.msh": gmsh22,
    "medit.mesh": lambda path: meshio.write(path, tagged("medit:ref")),
    "nastran.bdf": lambda path: meshio.write(path, tagged("nastran:ref")),
    "facets.vtu": lambda path: meshio.write(path, tagged("facet_tags")),
    "legacy.vtk": lambda path: meshio.write(
        path, tagged("cell_tags"), file_format="vtk42", binary=False
    ),
    "binary.vtk": lambda path: meshio.write(path, tagged("cell_tags")),
    "salome.med": med,
}


@pytest.mark.parametrize("name", WRITERS)
def test_numbers_of_triangles_are_sets(tmp_path, name):
    WRITERS[name](tmp_path / name)
    body = read_body(tmp_path / name)
    for number, side in enumerate(("left", "right", "top"), start=1):
        facets = body.mesh.facet_set(str(number))
        assert len(facets) == len(BLOCK.facet_set(side))
        np.testing.assert_allclose(
            np.sort(body.mesh.nodes[np.unique(facets)], axis=0),
            np.sort(BLOCK.nodes[np.unique(BLOCK.facet_set(side))], axis=0),
        )
    (regions,) = body.unused
    assert len(np.unique(read_regions(tmp_path / name, regions.split(" ")[0]))) == 2


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_a_first_scene_of_each_can_be_simulated(tmp_path, capsys, name):
    WRITERS[name](tmp_path / name)
    code, told = answer(capsys, "init", tmp_path / name)
    assert code == 0
    assert {"1", "2", "3"} <= set(told["facet_sets"])
    assert any(note.startswith("in the mesh file and not used: ") for note in told["notes"])
    assert main(["simulate", told["out"]]) == 0
    assert main(["check", "mesh", told["out"], "--out", str(tmp_path / "mesh")]) == 0


def test_sets_that_meshio_joins_in_one_array(tmp_path):
    """Of VTU: all names joined, -1 for cells of no set."""
    none, count = np.empty(0, int), len(BLOCK.facet_set("left"))
    content = meshio.Mesh(
        BLOCK.nodes,
        [("tetra", BLOCK.elements), ("triangle", SIDES)],
        cell_sets={"fixed": [none, np.arange(count)], "pulled": [none, count + np.arange(count)]},
    )
    meshio.write(tmp_path / "block.vtu", content)
    mesh = read_mesh(tmp_path / "block.vtu")
    assert {name: len(rows) for name, rows in mesh.facet_sets.items()} == {"fixed": 8, "pulled": 8}


def test_counts_and_marks_of_no_group_are_no_sets(tmp_path):
    """A number for each triangle, and DOLFIN's largest number where nothing is marked."""
    content = tagged("vtkOriginalCellIds", np.arange(len(TAGS)))
    unmarked = np.where(TAGS == 1, np.uint64(1), np.uint64(2**64 - 1))
    content.cell_data["boundaries"] = [unmarked, np.zeros(len(REGIONS), np.uint64)]
    meshio.write(tmp_path / "block.vtu", content)
    assert set(read_mesh(tmp_path / "block.vtu").facet_sets) == {"1"}


def test_numbered_triangles_inside_are_named_and_left_out(tmp_path):
    inner = np.array([BLOCK.elements[0][[0, 1, 2]], BLOCK.elements[0][[0, 1, 3]]])
    inner = np.concatenate([inner, BLOCK.elements[0][[[0, 2, 3], [1, 2, 3]]]])
    content = meshio.Mesh(
        BLOCK.nodes,
        [("triangle", np.concatenate([SIDES, inner])), ("tetra", BLOCK.elements)],
        cell_data={"tags": [np.append(TAGS, [9] * 4), np.zeros(len(REGIONS), int)]},
    )
    meshio.write(tmp_path / "block.vtu", content)
    body = read_body(tmp_path / "block.vtu")
    assert set(body.mesh.facet_sets) == {"1", "2", "3"}
    assert any("group 9 (" in phrase for phrase in body.unused)


@pytest.mark.parametrize(
    ("fibres", "sheets"),
    [("fiber", "sheet"), ("FIB_DIR", "SHEET_DIR"), ("f0", "s0"), ("Fibers",) * 2],
)
def test_fibres_under_names_of_other_programs(tmp_path, fibres, sheets):
    along = np.tile([1.0, 0.0, 0.0], (len(BLOCK.elements), 1))
    data = {"n0": [along], sheets: [np.roll(along, 1, axis=1)], fibres: [along]}
    meshio.write(
        tmp_path / "block.vtu",
        meshio.Mesh(BLOCK.nodes, [("tetra", BLOCK.elements)], cell_data=data),
    )
    body = read_body(tmp_path / "block.vtu")
    np.testing.assert_array_equal(body.fibres, along)
    assert (body.sheets is None) == (fibres == sheets)
    assert body.unused == ("n0 of cells",)


def test_fibres_that_are_no_directions_are_named(tmp_path):
    data = {"fiber": [np.zeros((len(BLOCK.elements), 3))]}
    meshio.write(
        tmp_path / "block.vtu",
        meshio.Mesh(BLOCK.nodes, [("tetra", BLOCK.elements)], cell_data=data),
    )
    body = read_body(tmp_path / "block.vtu")
    assert body.fibres is None
    assert "'fiber' at element 0 has length 0" in body.unused[0]


def abaqus(mesh, text, first=11):
    """An input file of a part with the block's nodes and elements, and ``text``."""
    rows = [f"{k}, {x}, {y}, {z}" for k, (x, y, z) in enumerate(mesh.nodes.tolist(), first)]
    kind = "c3d4" if mesh.order == 1 else "C3D10M"
    rows += [f"*Element, type={kind},\nelset=tissue"]
    for k, nodes in enumerate((mesh.elements + first).tolist(), start=1):
        words = [str(k), *map(str, nodes)]
        rows += [", ".join(words[:8]) + ("," if words[8:] else ""), ", ".join(words[8:])]
    return "*Heading\n** a comment\n*Part, name=P\n*Node\n" + "\n".join(rows) + "\n" + text


@pytest.mark.parametrize("mesh", [BLOCK, to_quadratic(BLOCK)], ids=["linear", "quadratic"])
def test_sets_and_surfaces_of_abaqus(tmp_path, mesh):
    left = np.flatnonzero(mesh.nodes[:, 0] == 0.0) + 11
    on_left = mesh.elements_behind(mesh.facet_set("left"))
    places = {
        (0, 1, 2): "S1", (0, 1, 3): "S2", (1, 2, 3): "S3", (0, 2, 3): "S4",
    }  # fmt: skip
    faces = [
        f"{k + 1}, {places[tuple(np.flatnonzero(np.isin(mesh.elements[k][:4], row[:3])).tolist())]}"
        for k, row in zip(on_left, mesh.facet_set("left"), strict=True)
    ]
    text = "\n".join(
        [
            "*NSET, NSET=One",
            ", ".join(map(str, left[:3])) + ",",
            "*NSET, NSET=two",
            *map(str, left[3:]),
            "*NSET, NSET=both",
            "ONE, two",
            "*ELSET, ELSET=half, GENERATE",
            "1, 47, 2",
            "*End Part\n*Assembly, name=A\n*Instance, name=P-1, part=P\n*End Instance",
            "*Nset, nset=again, instance=P-1",
            "P-1.one, P-1.two, nobody",
            "*Surface, type=ELEMENT, name=load",
            *faces,
            "*Surface, type=NODE, name=points",
            "both,",
            "*Surface, name=empty",
            "half, SPOS",
            "*Nset, nset=nodes_of_half, elset=half",
            "*Element, type=T3D2, elset=wire",
            f"1001, {left[0]}, {left[1]}",
            "*Material, name=m",
        ]
    )
    (tmp_path / "block.inp").write_text(abaqus(mesh, text))
    body = read_body(tmp_path / "block.inp")
    for name in ("both", "again", "points"):
        np.testing.assert_array_equal(body.mesh.node_set(name), np.sort(left) - 11)
    assert len(body.mesh.facet_set("load")) == len(mesh.facet_set("left"))
    assert set(body.mesh.node_sets["load"]) == set(left - 11)
    np.testing.assert_array_equal(body.mesh.node_set("wire"), np.sort(left[:2]) - 11)
    assert "'nobody' in again" in body.unused
    assert "surface empty, which has no faces of solids" in body.unused
    assert "set nodes_of_half, which has no members of its own" in body.unused
    assert 'half (regions = "half")' in body.unused
    assert read_regions(tmp_path / "block.inp", "half").sum() == 24


def test_parts_of_abaqus_with_the_same_numbers_are_refused(tmp_path):
    (tmp_path / "two.inp").write_text(abaqus(BLOCK, "*Node\n11, 5., 5., 5.\n"))
    with pytest.raises(InputError, match=r"two.inp .*node 11 is at two places.*two parts"):
        read_mesh(tmp_path / "two.inp")


def test_nodes_of_abaqus_in_several_blocks_and_files(tmp_path):
    text = abaqus(BLOCK, "")
    start = text.index("*Node\n") + 6
    end = text.index("*Element")
    rows = text[start:end].splitlines()
    (tmp_path / "nodes.txt").write_text("*NODE, NSET=fixed\n" + "\n".join(rows[:9]) + "\n")
    text = text[:start] + "\n".join(rows[9:]) + "\n*INCLUDE, INPUT=nodes.txt\n" + text[end:]
    (tmp_path / "block.inp").write_text(text)
    assert read_mesh(tmp_path / "block.inp").node_set("fixed").size == 9


def xml(surface, binary):
    """VTK's PolyData in XML, as text or in base64."""

    def array(name, values, kind, more=""):
        head = f'<DataArray type="{kind}" Name="{name}" {more}format='
        if not binary:
            return f'{head}"ascii">{" ".join(map(str, values.ravel().tolist()))}</DataArray>'
        raw = values.astype({"Float32": "<f4", "Int64": "<i8"}[kind]).tobytes()
        return f'{head}"binary">{base64.b64encode(struct.pack("<I", len(raw)) + raw).decode()}</DataArray>'

    none = "".join(array(name, np.empty(0, int), "Int64") for name in ("connectivity", "offsets"))
    return (
        '<VTKFile type="PolyData" version="0.1" byte_order="LittleEndian"><PolyData>'
        f'<Piece NumberOfPoints="{len(BLOCK.nodes)}" NumberOfVerts="0" NumberOfLines="0" '
        f'NumberOfStrips="0" NumberOfPolys="{len(surface)}"><PointData></PointData><Points>'
        + array("Points", BLOCK.nodes, "Float32", 'NumberOfComponents="3" ')
        + f"</Points><Verts>{none}</Verts><Polys>"
        + array("connectivity", surface, "Int64")
        + array("offsets", 3 * np.arange(1, len(surface) + 1), "Int64")
        + "</Polys></Piece></PolyData></VTKFile>"
    ).encode()


def legacy(surface, binary):
    """VTK's PolyData in a legacy file, with normals at its points."""

    def numbers(values, kind):
        text = " ".join(map(str, values.ravel().tolist())).encode()
        return (values.astype(kind).tobytes() if binary else text) + b"\n"

    rows = np.column_stack([np.full(len(surface), 3), surface])
    return (
        b"# vtk DataFile Version 4.2\nsurface\n%s\nDATASET POLYDATA\n"
        % (b"BINARY" if binary else b"ASCII")
        + b"POINTS %d float\n" % len(BLOCK.nodes)
        + numbers(BLOCK.nodes, ">f4")
        + b"POLYGONS %d %d\n" % (len(rows), rows.size)
        + numbers(rows, ">i4")
        + b"\nPOINT_DATA %d\nNORMALS Normals float\n" % len(BLOCK.nodes)
        + numbers(BLOCK.nodes, ">f4")
    )


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize(("write", "name"), [(xml, "a.vtp"), (legacy, "a.vtk")])
def test_polydata_is_a_surface_and_no_body(tmp_path, capsys, write, name, binary):
    (tmp_path / name).write_bytes(write(BLOCK.surface, binary))
    surface = read_surface(tmp_path / name, "endocardium")
    assert surface.volume == pytest.approx(2000.0, rel=1e-5)
    assert "it has no tetrahedra, only triangle" in complaint(capsys, "init", tmp_path / name)
    (tmp_path / name).write_bytes(write(BLOCK.surface[:0], binary))
    with pytest.raises(InputError, match=name):
        read_surface(tmp_path / name, "endocardium")


def test_the_first_format_of_gmsh_is_refused_by_name(tmp_path, capsys):
    (tmp_path / "old.msh").write_text("$NOD\n1\n1 0 0 0\n$ENDNOD\n$ELM\n0\n$ENDELM\n")
    line = complaint(capsys, "init", tmp_path / "old.msh")
    assert "Gmsh's format 1" in line
    assert "msh41" in line


@pytest.mark.parametrize(
    ("names", "cavity", "fixed"),
    [
        (("LV", "EPI", "BASE"), "LV", "BASE"),
        (("ENDO", "WALL", "BASE"), "ENDO", "BASE"),
        (("ENDO_LV", "epicardium_lv", "base"), "ENDO_LV", "base"),
        (("lv_endo", "epi", "lv_base"), "lv_endo", "lv_base"),
        (("LeftVentricleEndo", "Outer", "Base"), "LeftVentricleEndo", "Base"),
        (("endo", "epi", "left_ventricle_fixed"), "endo", "left_ventricle_fixed"),
    ],
)
def test_names_of_walls_of_other_programs(tmp_path, capsys, names, cavity, fixed):
    lv = human_ventricle(4, 8, 1)
    walls = [lv.facet_set(name) for name in ("endocardium", "epicardium", "base")]
    numbers = np.concatenate([np.full(len(each), k) for k, each in enumerate(walls, start=1)])
    content = meshio.Mesh(
        1000.0 * lv.nodes,  # in um, as openCARP has them
        [("triangle", np.concatenate(walls)), ("tetra", lv.elements)],
        cell_data={"gmsh:physical": [numbers, np.full(len(lv.elements), 4)]},
        field_data={name: np.array([k, 2]) for k, name in enumerate(names, start=1)},
    )
    content.cell_data["gmsh:geometrical"] = content.cell_data["gmsh:physical"]
    content.field_data["myocardium"] = np.array([4, 3])
    meshio.write(tmp_path / "lv.msh", content, file_format="gmsh22", binary=False)
    code, told = answer(capsys, "init", tmp_path / "lv.msh")
    assert code == 0
    notes = " ".join(told["notes"])
    assert "taken to be um" in notes
    assert f"pressure on '{cavity}'" in notes
    assert f"held at '{fixed}'" in notes
    assert told["law"] == "holzapfel_ogden"
    assert json.dumps(names[1]) in (tmp_path / "lv.toml").read_text()
