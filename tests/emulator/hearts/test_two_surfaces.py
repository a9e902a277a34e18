"""A wall between two surfaces: closed forms, whatever the surfaces' form, and what is refused."""

import re
import sys
from dataclasses import replace

import meshio
import numpy as np
import pytest

from calibrate.cli import main
from cli_support import answer, complaint
from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.geometry.discretisation import discretise
from emulator.geometry.facets import mean_normal
from emulator.geometry.generators.ellipsoid import HUMAN, human_ventricle
from emulator.geometry.io import write_mesh
from emulator.geometry.mesh import signed_volumes
from emulator.geometry.refinement import refined
from emulator.hearts.heart import mesh_wall
from emulator.hearts.surfaces import Surface, read_surface
from emulator.scenes.draft import draft_scene
from surface_support import INSIDE, OUTSIDE, ellipsoid, write

TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
TURN *= np.linalg.det(TURN)  # a rotation
SHIFT = np.array([120.0, -40.0, 65.0])  # mm, as in a scanner's coordinates


@pytest.fixture(scope="session")
def rough(tmp_path_factory):
    """Two closed rough surfaces, as STL."""
    folder = tmp_path_factory.mktemp("rough")
    files = {"endo": INSIDE, "epi": OUTSIDE}
    return [write(folder / f"{name}.stl", ellipsoid(axes)) for name, axes in files.items()]


@pytest.fixture(scope="session")
def open_ones(tmp_path_factory):
    """Two surfaces that end at their rims, turned and shifted, in cm, as PLY."""
    folder, mesh = tmp_path_factory.mktemp("open"), human_ventricle(20, 48, 1)
    nodes = 0.1 * (mesh.nodes @ TURN.T + SHIFT)
    return [
        write(folder / f"{name}.ply", nodes[mesh.facet_set(name)])
        for name in ("endocardium", "epicardium")
    ]


@pytest.fixture(scope="session")
def made(rough):
    """The mesh of the rough surfaces."""
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    return mesh_wall(*rough, axis=(0, 0, 2), base_height=HUMAN.base)


def test_volumes_and_thickness_are_those_of_the_ellipsoids(made):
    assert made.cavities["endocardium"][0] == pytest.approx(HUMAN.cavity_volume / 1000.0, rel=0.01)
    assert made.wall[0] == pytest.approx(HUMAN.volume / 1000.0, rel=0.01)
    assert made.cavities["endocardium"][0] == pytest.approx(
        made.cavities["endocardium"][1], rel=2e-3
    )
    assert 6.5 < made.thickness.least < 7.5  # 7 at the apex
    assert 10.8 < made.thickness.most < 11.3  # 11 at the equator
    assert made.local_thickness().max() < 13.0


def test_sets_cover_the_surface_once_and_elements_are_sound(made):
    mesh = made.mesh
    assert mesh.order == 2
    rows = np.concatenate([np.sort(each, axis=1) for each in mesh.facet_sets.values()])
    assert set(mesh.facet_sets) == {"endocardium", "epicardium", "base"}
    assert len(np.unique(rows, axis=0)) == len(rows) == len(mesh.surface)  # watertight
    assert signed_volumes(mesh.nodes, mesh.elements).min() > 0.0
    assert discretise(mesh).weights.min() > 0.0
    assert (made.quality.parts, made.quality.flat) == (1, 0)
    np.testing.assert_allclose(mesh.nodes[mesh.node_set("base"), 2], HUMAN.base, atol=1e-9)
    np.testing.assert_allclose(mean_normal(mesh.nodes[mesh.facet_set("base")]), made.axis)
    for name, short, long in (("endocardium", *INSIDE), ("epicardium", *OUTSIDE)):
        x = mesh.nodes[mesh.node_set(name)] / [short, short, long]
        np.testing.assert_allclose(np.linalg.norm(x, axis=1), 1.0, atol=0.02)
        (apex,) = mesh.node_set(f"apex_{name}")
        assert mesh.nodes[apex, 2] == pytest.approx(-long, abs=1.0)


def test_open_surfaces_anywhere_tell_their_axis(open_ones):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    found = mesh_wall(*open_ones, unit="cm", size=9.0, order=1)
    np.testing.assert_allclose(found.axis, TURN[:, 2], atol=1e-4)
    np.testing.assert_allclose(found.base, TURN[:, 2] * HUMAN.base + SHIFT, atol=0.1)
    assert found.cavities["endocardium"][1] == pytest.approx(HUMAN.cavity_volume / 1000.0, rel=0.01)
    assert found.cut_off == (0.0, 0.0)
    assert any("more than 1 % off" in line for line in found.sentences())  # linear and coarse


def test_rims_that_are_not_flat_are_cut_at_their_lowest_point(open_ones):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    outer, inner = (read_surface(each, "x", 10.0) for each in open_ones[::-1])
    k = TURN[:, 2]
    height = (outer.points - SHIFT) @ k
    saddle = 3.0 * np.clip(height / 20.0, 0.0, 1.0) * np.sin(2.0 * np.arctan2(*((outer.points - SHIFT) @ TURN[:, :2]).T))  # fmt: skip
    found = mesh_wall(
        inner, replace(outer, points=outer.points + saddle[:, None] * k), size=9.0, order=1
    )
    assert found.cut_off[0] == pytest.approx(6.0, abs=0.6)
    assert (found.base - SHIFT) @ k == pytest.approx(HUMAN.base - 3.0, abs=0.3)


def test_fibres_by_rule_follow_the_axis_that_the_base_tells(made, tmp_path):
    turned = replace(made.mesh, nodes=made.mesh.nodes @ TURN.T)
    fibres = []
    for name, mesh in (("upright", made.mesh), ("turned", turned)):
        write_mesh(tmp_path / f"{name}.vtu", mesh)
        scene = draft_scene(tmp_path / f"{name}.vtu", tmp_path / f"{name}.toml").scene
        fibres.append(np.asarray(scene.fibres))
        assert scene.mesh.order == 2
    assert np.isfinite(fibres[0]).all()
    # Near the long axis the circumferential direction is arbitrary.
    between = np.abs(np.einsum("mqi,mqi->mq", fibres[0] @ TURN.T, fibres[1]))
    assert np.quantile(between, 0.02) > 0.999


def test_edges_too_long_for_the_curvature_are_straightened(rough):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    found = mesh_wall(*rough, axis=(0, 0, 1), base_height=HUMAN.base, size=14.0, smooth=5)
    assert 0 < found.folded[0] < 0.1 * len(found.mesh.elements)
    assert 0.0 < found.folded[1] < 14.0
    assert any("curved elements were folded" in line for line in found.sentences())
    discretise(refined(found.mesh).mesh)


def test_a_sound_wall_raises_no_doubts_and_says_what_is_cut_off(made):
    assert made.warnings == ()
    assert made.folded == (0, 0.0)
    height = HUMAN.long_epicardium - HUMAN.base
    assert made.cut_off[0] == pytest.approx(height, abs=0.5)
    whole = 4.0 / 3.0 * np.pi * HUMAN.short_epicardium**2 * HUMAN.long_epicardium / 1000.0
    below = (HUMAN.cavity_volume + HUMAN.volume) / 1000.0
    assert made.cut_off[1] == pytest.approx(whole - below, rel=0.02)


def test_an_epicardium_of_both_ventricles_is_questioned(rough, tmp_path, capsys):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    both = write(tmp_path / "both.stl", ellipsoid((55.0, 70.0), 8.0, (18.0, 0.0, 0.0)))
    words = ["mesh", "--endocardium", rough[0], "--epicardium", both, "--axis", 0, 0, 1]
    words += ["--base-height", 20, "--size", 14, "--order", 1, "--out", tmp_path / "lv.vtu"]
    code, told = answer(capsys, *words)
    assert code == 0
    question = "thicker than 20 mm: a right ventricle?"
    assert any(question in line for line in told["warnings"])
    assert main(list(map(str, words))) == 0
    assert question in capsys.readouterr().out


@pytest.mark.slow
def test_a_wall_too_thin_for_a_size_names_one_that_fits(rough):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    inner = read_surface(rough[0], "endocardium")
    outer = Surface("epicardium", 1.05 * inner.points, inner.triangles)
    plane = {"axis": (0, 0, 1), "base_height": HUMAN.base, "order": 1}
    with pytest.raises(InputError, match=r"too thin for edges of 20 mm: --size .* fits") as error:
        mesh_wall(inner, outer, size=20.0, **plane)
    size = float(re.search("--size (.*) fits", str(error.value)).group(1))
    assert mesh_wall(inner, outer, size=size, **plane).size == size < 20.0
    near = Surface("epicardium", 1.002 * inner.points, inner.triangles)
    with pytest.raises(InputError, match=r"too thin for edges of 7 mm at .* or any between"):
        mesh_wall(inner, near, size=20.0, **plane)


@pytest.mark.slow
def test_the_command_draws_and_what_it_wrote_is_solved(rough, tmp_path, capsys):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    out, picture = tmp_path / "lv.vtu", tmp_path / "lv.png"
    words = ("--axis", 0, 0, 1, "--base-height", HUMAN.base, "--size", 11, "--smooth", 5)
    code, told = answer(
        capsys, "mesh", "--endocardium", rough[0], "--epicardium", rough[1], *words,
        "--out", out, "--picture", picture,
    )  # fmt: skip
    assert code == 0
    assert told["cavities"]["endocardium"]["mesh"] == pytest.approx(
        HUMAN.cavity_volume / 1000.0, rel=0.02
    )
    assert picture.stat().st_size > 10_000
    scene = draft_scene(out, tmp_path / "lv.toml").scene
    assert Simulator(scene).solve(scene.centre).converged


def moved(path, by):
    given = read_surface(path, "x")
    return Surface(path.stem, given.points + by, given.triangles)


def with_hole(path):
    given = read_surface(path, "endocardium")
    middle = given.points[given.triangles].mean(axis=1)
    near = np.linalg.norm(middle - [0.0, -20.0, -20.0], axis=1) < 8.0
    return Surface("endocardium", given.points, given.triangles[~near])


def cut_open(path):
    """Without its cap above the height 15 to 25 mm, which leans."""
    given = read_surface(path, "endocardium")
    middle = given.points[given.triangles].mean(axis=1)
    cap = middle[:, 2] > 20.0 + 0.25 * middle[:, 0]
    return Surface("endocardium", given.points, given.triangles[~cap])


WRONG = {
    "swapped": (lambda a, b: ((b, a), {}), "endocardium and epicardium are swapped"),
    "crossing": (lambda a, b: ((moved(a, [15, 0, 0]), b), {}), r"(endo|epi)cardium crosses (endo|epi)cardium: \d+ of its"),
    "apart": (lambda a, b: ((moved(a, [90, 0, 0]), b), {}), "endocardium lies outside of epicardium"),
    "metres": (lambda a, b: ((a, b), {"unit": "mm"}), r"endocardium: it is 0\.\d+ mm from corner to corner"),
    "hole": (lambda a, b: ((with_hole(a), b), {}), r"endocardium: it has 2 openings, the smallest of .* --base-height"),
    "no plane": (lambda a, b: ((a, b), {"base_height": None}), "endocardium: it is closed; give the base plane"),
    "no axis": (lambda a, b: ((a, b), {"axis": None}), "long axis: give it, from apex to base .--axis X Y Z"),
    "zero axis": (lambda a, b: ((a, b), {"axis": (0, 0, 0)}), "long axis .* expected three numbers"),
    "beside": (lambda a, b: ((a, b), {"base_height": 90.0}), "endocardium: all of it is below the base"),
    "both": (lambda a, b: ((a, b), {"base_point": (0, 0, 0)}), "give a height or a point, not both"),
    "opening": (lambda a, b: ((cut_open(a), b), {}), "its opening reaches below the base plane, down to 14.* mm along the axis"),
    "size": (lambda a, b: ((a, b), {"size": -1.0}), "--size -1.0 mm: expected edges above 0"),
    "turned": (lambda a, b: ((cut_open(a), b), {"axis": (0, 0, -1), "base_height": 0}), "it has 2 openings.* turn --axis around"),
    "no number": (lambda a, b: ((a, b), {"base_height": np.nan}), "base plane nan: expected a finite height, --base-height"),
    "large": (lambda a, b: ((a, b), {"unit": "cm"}), "endocardium: it is 1.* mm from corner to corner, lengths being taken as cm"),
    "order": (lambda a, b: ((a, b), {"order": 3}), "order 3: expected 1 or 2"),
    "smooth": (lambda a, b: ((a, b), {"smooth": -1}), "smooth -1: expected 0 times or more"),
    "unit": (lambda a, b: ((a, b), {"unit": "inch"}), "unit 'inch' is unknown; known: mm, cm, m"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_told_in_one_line(case, rough, tmp_path):
    build, message = WRONG[case]
    files = rough
    if case == "metres":
        files = [write(tmp_path / f.name, 1e-3 * ellipsoid(s, 5.0)) for f, s in zip(rough, (INSIDE, OUTSIDE), strict=True)]  # fmt: skip
    surfaces, words = build(*files)
    with pytest.raises(InputError, match=message) as error:
        mesh_wall(*surfaces, **{"axis": (0, 0, 1), "base_height": HUMAN.base, **words})
    assert "\n" not in str(error.value)


def test_without_gmsh_the_command_names_the_extra(rough, tmp_path, capsys, monkeypatch):
    words = (
        "mesh", "--endocardium", rough[0], "--epicardium", rough[1], "--axis", 0, 0, 1,
        "--base-height", 20, "--out", tmp_path / "lv.vtu",
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "gmsh", None)
    line = complaint(capsys, *words)
    assert line == "calibrate: meshing needs gmsh: pip install 'soft-tissue-calibrate[gmsh]'"

    def no_library(name):
        raise OSError("libGLU.so.1: cannot open shared object file")

    monkeypatch.setattr("emulator.hearts.remeshing.import_module", no_library)
    assert "gmsh is installed but does not load (libGLU.so.1" in complaint(capsys, *words)


def test_a_file_of_tetrahedra_is_no_surface(tmp_path, capsys):
    mesh = human_ventricle(3, 6, 1)
    meshio.write(tmp_path / "lv.vtu", meshio.Mesh(mesh.nodes, [("tetra", mesh.elements)]))
    file = tmp_path / "lv.vtu"
    line = complaint(capsys, "mesh", "--endocardium", file, "--epicardium", file, "--out", tmp_path / "o.vtu")  # fmt: skip
    assert "it has tetra; expected triangles only" in line
