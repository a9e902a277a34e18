"""Surfaces of an image's frames as data."""

from dataclasses import replace

import numpy as np
import pytest

import emulator as em
from calibrate.cli import main
from calibrate.measurements.data import read_measurements, write_data
from calibrate.measurements.frames import along_normals, frame_data, spread_evenly
from cli_support import complaint
from emulator.core.errors import InputError
from emulator.hearts.surfaces import Surface, surface
from scene_support import block
from surface_support import write

WALL = "endocardium"


@pytest.fixture(scope="module")
def scene():
    return em.scenes.left_ventricle(rings=10, around=24, layers=1, order=1)


def frame(scene, change, facet_set=WALL):
    """The surface of a facet set whose points have moved."""
    return surface(facet_set, change(scene.mesh.nodes), scene.mesh.facet_set(facet_set))


def test_a_flat_face_that_moved():
    scene = block(cells=(4, 4, 4))
    face = Surface("right", scene.mesh.nodes + [0.3, 0.2, -0.1], scene.mesh.facet_set("right"))
    observe, data = frame_data(scene, {"right@pushed": face}, 4)
    assert list(observe.parts) == ["surface:right@pushed"]  # a plane has no volume
    np.testing.assert_allclose(data["surface:right@pushed"], 0.3, atol=1e-12)


def test_a_cavity_that_grew(scene):
    """Small displacements: their components along the normals, and the volume of the frame."""
    grown = frame(scene, lambda X: 1.03 * X)
    observe, data = frame_data(scene, {f"{WALL}@late": grown}, 40)
    part = observe.parts[f"surface:{WALL}@late"]
    expected = 0.03 * np.sum(part.points * part.normals, axis=1)
    np.testing.assert_allclose(data[f"surface:{WALL}@late"], expected, atol=0.12)
    assert (data[f"surface:{WALL}@late"] < 0.0).all()  # outwards is into the tissue
    rest = observe.parts[f"volume:{WALL}@late"].cavity.rest
    assert data[f"volume:{WALL}@late"] == pytest.approx(1.03**3 * rest, rel=1e-9)


def test_points_are_even_and_away_from_the_rim(scene):
    places = spread_evenly(scene.mesh, WALL, 30)
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + 1e9 * np.eye(30)
    assert apart.min() > 5.0  # mm, of a wall of some 80 cm2
    base = scene.mesh.nodes[scene.mesh.node_set("base")]
    assert np.linalg.norm(places[:, None] - base[None], axis=-1).min() > 4.0


def test_a_line_that_meets_nothing_or_grazes_has_no_way():
    triangle = Surface("one", np.array([[0.0, 0, 1], [4, 0, 1], [0, 4, 1]]), np.array([[0, 1, 2]]))
    points = np.array([[1.0, 1, 0], [5, 5, 0], [1, 1, 0], [1, 1, 0], [0.5, 0.5, 0]])
    normals = np.array([[0, 0, 1.0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 0, 1]])
    ways = along_normals(points, normals, triangle, 3.0)
    np.testing.assert_allclose(
        ways, [1.0, np.nan, np.nan, np.nan, 1.0]
    )  # the third faces otherwise
    assert np.isnan(along_normals(points[:1], normals[:1], triangle, 0.5)).all()


def test_files_are_read_as_they_were_written(scene, tmp_path):
    surfaces = {
        f"{wall}@{state}": frame(scene, lambda X, k=k: k * X, wall)
        for state, k in (("early", 1.01), ("late", 1.03))
        for wall in (WALL, "epicardium")
    }
    observe, data = frame_data(scene, surfaces, 12)
    data["surface:epicardium@late"][3] = np.nan
    write_data(tmp_path / "frames.csv", observe, data)
    read, again, _ = read_measurements(scene, tmp_path / "frames.csv")
    named = {name.replace(f"volume:{WALL}", "volume"): value for name, value in data.items()}
    renamed = {name.replace(f"volume:{WALL}", "volume"): value for name, value in again.items()}
    assert set(named) == set(renamed)
    for name, value in named.items():
        np.testing.assert_allclose(renamed[name], value, atol=1e-9)
    assert read.states == ("early", "late")


def test_by_the_command_line(scene, tmp_path, capsys):
    grown = frame(scene, lambda X: 1.02 * X)
    file = str(write(tmp_path / "late.stl", grown.points[grown.triangles]))
    built = ["left_ventricle"]
    out = str(tmp_path / "frames.csv")
    words = ["frames", *built, "--surface", f"{WALL}@late={file}", "--points", "9", "--out", out]
    assert main(words) == 0
    assert f"surface:{WALL}@late" in capsys.readouterr().out
    assert "give each as SET@STATE=FILE" in complaint(
        capsys, "frames", *built, "--surface", "late.stl", "--out", out
    )
    twice = f"{WALL}@late={file}", f"{WALL}@late=other.stl"
    line = complaint(capsys, "frames", *built, "--surface", *twice, "--out", out)
    again = f"{WALL}@late={file}", f"{WALL}@later={file}"
    assert f"'{WALL}@late' and '{WALL}@later' are one surface, {file}; each" in complaint(
        capsys, "frames", *built, "--surface", *again, "--out", out
    )
    assert f"--surface '{WALL}@late' is there twice, {file} and other.stl; give one" in line


def test_what_is_no_frame_is_refused(scene):
    grown = frame(scene, lambda X: 1.02 * X)
    with pytest.raises(InputError, match="in the mesh's place and unit"):
        frame_data(scene, {WALL: replace(grown, points=grown.points + 500.0)})
    with pytest.raises(InputError, match="facet set 'liver'"):
        frame_data(scene, {"liver@a": grown})
    with pytest.raises(InputError, match="0 points; give 1 or more"):
        frame_data(scene, {WALL: grown}, 0)
    with pytest.raises(InputError, match="ask for fewer points than 5000"):
        frame_data(scene, {WALL: grown}, 5000)


@pytest.mark.parametrize("share", [0.75, 0.6])
def test_the_other_side_of_a_cavity_that_empties_is_not_taken(scene, share):
    """A line through the cavity meets both sides; the far one faces the other way."""
    middle = scene.mesh.nodes[np.unique(scene.mesh.facet_set(WALL))].mean(axis=0)
    small = frame(scene, lambda X: middle + share * (X - middle))
    observe, data = frame_data(scene, {f"{WALL}@es": small}, 40)
    part, ways = observe.parts[f"surface:{WALL}@es"], data[f"surface:{WALL}@es"]
    known = np.isfinite(ways)
    assert known.mean() > 0.7  # the others are near the rim, which has moved
    expected = (1.0 - share) * np.sum((middle - part.points) * part.normals, axis=1)
    assert np.abs(ways - expected)[known].max() < 4.0  # mm, of 5 to 30
