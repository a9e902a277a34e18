"""``calibrate frames --field``: tables of a correlation to the data of a run, and back."""

from dataclasses import replace

import numpy as np
import pytest

import emulator as em
from calibrate.cli import main
from calibrate.measurements.data import read_measurements
from cli_support import answer, complaint
from emulator.geometry.generators.box import box
from emulator.geometry.io import write_mesh

SCENE = """
law = "neo_hookean"
mesh = "sheet.vtu"
[[supports]]
node_set = "left"
[[supports]]
node_set = "right"
displacement = [1.0, 0.0, 0.0]
amount = "pull"
[parameters.mu]
unit = "kPa"
range = [5, 20]
[parameters.pull]
range = [0.0, 3.0]
[constants]
lam = 30.0
"""
PADS = "pads.csv:ux"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_mesh("sheet.vtu", box((20.0, 10.0, 1.0), (4, 2, 1)))
    (tmp_path / "sheet.toml").write_text(SCENE)
    points = [f"{k},{2.0 * k + 3.0},{1.0 + k}" for k in range(6)]
    (tmp_path / "points.csv").write_text("\n".join(["point,x,y", *points]))
    moved = [
        f"{f},{k},{0.01 * f * k},{0.02 * f}" for f in (0, 5, 9) for k in range(6) if f + k < 14
    ]
    (tmp_path / "moved.csv").write_text("\n".join(["frame,point,ux,uy", *moved]))
    (tmp_path / "pads.csv").write_text("frame,ux\n0,0\n5,-1.0\n9,-2.0\n")
    (tmp_path / "force.csv").write_text("u,F\n-0.0,0\n-1.5,-0.3\n-3.0,-0.9\n")
    return tmp_path


FIELD = ("frames", "sheet.toml", "--field", "points.csv", "moved.csv", "--amount", f"pull={PADS}")


def test_what_is_written_is_read_as_data_of_states(folder, capsys):
    words = (*FIELD, "--force", "reaction:right:x=force.csv:u:F", "--points", "6")
    code, said = answer(capsys, *words, "--out", "field.csv")
    assert code == 0
    assert said["data"]["displacement@9"]["missing"] == 1  # point; none has a uz
    assert main(["frames", *words[1:], "--out", "again.csv"]) == 0
    out = capsys.readouterr().out
    assert 'kind "gain"' in out  # moduli are as uncertain as the thickness
    assert "points of displacement@9 without a value, left out: 1 (at (" in out
    scene = em.find_scene("sheet.toml")
    observe, data, known = read_measurements(scene, "field.csv")
    assert known == {"pull@5": 1.0, "pull@9": 2.0}  # the frame at rest is none
    assert set(observe.states) == {"5", "9"}
    assert data["reaction:right:x@5"] == pytest.approx(-0.2)
    assert data["reaction:right:x@9"] == pytest.approx(-0.5)
    places = observe.parts["displacement@5"].points
    order = np.argsort(places[:, 0])
    np.testing.assert_allclose(places[order, 0], 2.0 * np.arange(6) + 3.0)
    np.testing.assert_allclose(places[:, 2], 1.0)
    np.testing.assert_allclose(data["displacement@5"][order, 0], 0.05 * np.arange(6))
    np.testing.assert_allclose(data["displacement@5"][:, 1], 0.1)


def test_some_frames_and_points_may_be_enough(folder, capsys):
    code, said = answer(capsys, *FIELD, "--only", "9", "--points", "3", "--out", "field.nc")
    assert code == 0
    assert list(said["data"]) == ["displacement@9"]
    observe, _, known = read_measurements(em.find_scene("sheet.toml"), "field.nc")
    assert observe.parts["displacement@9"].points.shape == (3, 3)
    assert known == {"pull@9": 2.0}


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((*FIELD, "--only", "7"), "no frame '7'"),
        ((*FIELD[:-1], "pull=pads.csv:uy"), "column 'uy' is missing"),
        ((*FIELD[:-1], "pull=none.csv:ux"), "none.csv does not exist"),
        ((*FIELD, "--force", "reaction:right:x=force.csv"), "give REACTION=FILE:AMOUNT:COLUMN"),
        ((*FIELD, "--force", "reaction:top:x=force.csv:u:F"), "no support on 'top'"),
        ((*FIELD, "--surface", "top@a=a.stl"), "give either --surface or --field"),
        ((*FIELD[:-1], f"pul={PADS}"), "--amount: parameter 'pul' is unknown"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(folder, capsys, words, line):
    assert line in complaint(capsys, *words, "--out", "field.csv")


def test_a_force_that_ends_before_the_frames_is_refused(folder, capsys):
    (folder / "force.csv").write_text("u,F\n0,0\n-1.5,-0.3\n")
    words = (*FIELD, "--force", "reaction:right:x=force.csv:u:F", "--out", "field.csv")
    assert "goes from 0 to 1.5, frame '9' is at 2" in complaint(capsys, *words)


def test_amounts_that_the_scene_cannot_have_are_refused(folder, capsys):
    (folder / "pads.csv").write_text("frame,ux\n0,0\n5,100\n9,2000\n")
    told = complaint(capsys, *FIELD, "--out", "field.csv")
    assert (
        "2 of 2 amounts, frame '5' at 100, are outside of the scene's range of 'pull', 0 to" in told
    )
    (folder / "pads.csv").write_text("frame,ux\n0,0\n5,3.0\n9,3.1\n")
    assert "1 of 2 amounts, frame '9' at 3.1," in complaint(capsys, *FIELD, "--out", "field.csv")
    assert main([*FIELD, "--only", "5", "--out", "field.csv"]) == 0


def test_a_field_says_why_it_needs_the_side_that_the_camera_sees(folder, capsys):
    sheet = box((20.0, 10.0, 1.0), (4, 2, 1))
    front = {("front" if n == "top" else n): facets for n, facets in sheet.facet_sets.items()}
    write_mesh("sheet.vtu", replace(sheet, facet_sets=front))
    told = complaint(capsys, *FIELD, "--out", "field.csv")
    assert "facet set 'top' is not in the mesh; its sets:" in told
    assert "name the side that the camera sees 'top'" in told
