"""Surfaces of frames that contradict the body or each other, by the command line."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import emulator as em
from calibrate.measurements.frame_checks import frame_doubts
from calibrate.measurements.frames import frame_data
from cli_support import answer
from emulator.geometry.fibres import BOTH
from emulator.geometry.generators.biventricle import biventricle
from emulator.hearts.surfaces import Surface, clipped, read_surface, surface
from surface_support import write

LEFT, RIGHT, OUTSIDE = BOTH
FILES = dict(zip(BOTH, ("LV_ENDOCARDIAL", "RV_ENDOCARDIAL", "EPICARDIAL"), strict=True))


@pytest.fixture(scope="module")
def heart(tmp_path_factory):
    """An idealised heart's scene, and its three surfaces."""
    folder, mesh = tmp_path_factory.mktemp("heart"), biventricle(rings=12, around=32)
    em.write_mesh(folder / "heart.vtu", mesh)
    scene = em.draft_scene(folder / "heart.vtu", folder / "heart.toml").scene
    return scene, {name: surface(name, mesh.nodes, mesh.facet_set(name)) for name in BOTH}


def changed(surfaces, change, *names):
    """The surfaces, those of ``names`` (default: all) with other points."""
    return {
        name: surface(name, change(each.points), each.triangles)
        if name in (names or BOTH)
        else each
        for name, each in surfaces.items()
    }


def doubts(scene, surfaces, points=40):
    frames = {f"{name}@f": each for name, each in surfaces.items()}
    observe, data = frame_data(scene, frames, points)
    return list(frame_doubts(scene.mesh, frames, observe, data))


def test_a_frame_that_contracts_raises_no_doubt(heart):
    scene, surfaces = heart
    frame = changed(surfaces, lambda X: X * [0.95, 0.95, 0.97] + [0.5, -1.0, 2.0])
    assert doubts(scene, frame) == []


def test_doubts_are_said_by_the_command(tmp_path, capsys):
    mesh = em.scenes.left_ventricle(rings=10, around=24, layers=1, order=1).mesh
    outside = surface("epicardium", mesh.nodes, mesh.facet_set("epicardium"))
    file = write(tmp_path / "epi.stl", 1.3 * outside.points[outside.triangles])
    words = ["frames", "left_ventricle", "--surface", f"endocardium@f={file}", "--points", "9"]
    code, told = answer(capsys, *words, "--out", tmp_path / "f.csv")
    assert code == 0
    assert any("is it of another wall?" in line for line in told["warnings"])


def turn(degrees, axis):
    matrix = Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix()
    return lambda X: (X - X.mean(axis=0)) @ matrix.T + X.mean(axis=0)


def as_left(surfaces, name):
    return {**surfaces, LEFT: Surface(LEFT, surfaces[name].points, surfaces[name].triangles)}


def holed(each):
    """Without a cap at the apex: a further opening, and fewer points that are met."""
    apex = each.points[np.argmin(each.points[:, 2])]
    return clipped(each, 12.0 - np.linalg.norm(each.points - apex, axis=1))


def cut_off(each):
    """What is below a plane at two fifths of its height, as of an image that ends there."""
    level = np.quantile(each.points[:, 2], 0.6)
    return clipped(each, each.points[:, 2] - level)


CASES = {
    "epicardium as left": (lambda s: as_left(s, OUTSIDE), "are they of one frame, and in one place?"),
    "epicardium alone": (lambda s: {LEFT: as_left(s, OUTSIDE)[LEFT]}, "is it of another wall?"),
    "mirrored": (lambda s: changed(s, lambda X: X * [-1.0, 1.0, 1.0] + [10.0, 0, 0], OUTSIDE), "mm off any shift, turn and growth"),
    "one shifted": (lambda s: changed(s, lambda X: X + [10.0, 0.0, 0.0], LEFT), "lv_endocardium@f: shifted by 9"),
    "one shifted beside the others": (lambda s: changed(s, lambda X: X + [0.0, 10.0, 0.0], RIGHT), "mm outside of epicardium@f"),
    "all shifted": (lambda s: changed(s, lambda X: X + [0.0, 10.0, 0.0]), "is it in its place?"),
    "one turned": (lambda s: changed(s, turn(15.0, [0, 0, 1.0]), OUTSIDE), "inside of rv_endocardium@f: are they of one frame, and in one place?"),
    "all turned": (lambda s: changed(s, turn(15.0, [1.0, 0, 0])), "from the mesh: is it in its place?"),
    "other frames": (lambda s: changed({n: s[n] for n in (LEFT, RIGHT)}, lambda X: 0.8 * X, LEFT), "ventricles fill and empty alike"),
    "other frames, wall": (lambda s: changed(s, lambda X: 0.7 * X, LEFT), "muscle keeps its volume"),
    "volume dropped": (lambda s: {**s, LEFT: holed(s[LEFT])}, "its volume is not in the data: it has 2 openings"),
    "points missing": (lambda s: {LEFT: cut_off(s[LEFT])}, "points are missing"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_what_cannot_be_is_questioned(case, heart):
    scene, surfaces = heart
    change, question = CASES[case]
    lines = doubts(scene, change(surfaces))
    assert any(question in line for line in lines), lines
    assert all("\n" not in line for line in lines)


@pytest.mark.slow
def test_frames_of_a_real_heart_raise_no_doubt(measured, tmp_path):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    folder = measured / "human_heart"
    files = {n: folder / f"{file}_018.obj" for n, file in FILES.items()}
    wall = em.hearts.mesh_wall(files[LEFT], files[OUTSIDE], right=files[RIGHT])
    em.write_mesh(tmp_path / "heart.vtu", wall.mesh)
    scene = em.draft_scene(tmp_path / "heart.vtu", tmp_path / "heart.toml").scene
    assert wall.warnings == ()
    for frame in range(0, 25, 4):
        surfaces = {n: read_surface(folder / f"{f}_{frame:03d}.obj", n) for n, f in FILES.items()}
        assert doubts(scene, surfaces, 60) == []
    mixed = {LEFT: folder / "LV_ENDOCARDIAL_010.obj", RIGHT: folder / "RV_ENDOCARDIAL_000.obj"}
    surfaces = {name: read_surface(path, name) for name, path in mixed.items()}
    assert any("one frame?" in line for line in doubts(scene, surfaces, 60))
