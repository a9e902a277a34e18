"""From a test's table to a posterior with FEM's verdict, by the commands a user types."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.cli import main
from calibrate.measurements.data import read_measurements
from calibrate.project import model_before_data, read_posterior
from calibrate.project.experiment import read_experiment
from calibrate.project.problem import simulator_of
from calibrate.project.specimen import draft_specimen
from calibrate.project.stated_priors import without_box
from emulator.core.errors import InputError
from emulator.scenes.file import read_scene
from emulator.specimens.grips import Grips, GripStresses

A, B = 8.0, 6.0  # W = a (exp(b (I1 - 3)) - 1) / 2 b


def table(noise=0.0, seed=0):
    """Two biaxial tests of an isotropic exponential, incompressible, in closed form."""
    rows = ["protocol,branch,stretch_x,stretch_y,stress_x [kPa],stress_y [kPa]"]
    rng = np.random.default_rng(seed)
    for name, ratio in (("equal", 1.0), ("half", 0.5)):
        for strain in np.linspace(0.0, 0.2, 9):
            s, r = 1.0 + strain, 1.0 + ratio * strain
            z = 1.0 / (s * r)
            factor = A * np.exp(B * (s**2 + r**2 + z**2 - 3.0))
            P = factor * np.array([s - z**2 / s, r - z**2 / r]) + noise * rng.normal(size=2)
            rows.append(f"{name},loading,{s:.12g},{r:.12g},{P[0]:.12g},{P[1]:.12g}")
        rows.append(f"{name},unloading,1.1,{1.0 + 0.5 * ratio * 0.2:.12g},0.5,0.5")
    return "\n".join(rows) + "\n"


def test_files_are_written_and_say_what_was_guessed(tmp_path):
    (tmp_path / "test.csv").write_text(table())
    draft = draft_specimen(tmp_path / "test.csv", tmp_path / "test.toml")
    assert draft.scene.law.name == "holzapfel_gasser_ogden"
    notes = " ".join(draft.notes)
    for words in ("18 states in 2 tests (equal, half)", "2 rows of unloading are left out", "kPa"):
        assert words in notes
    problem = read_experiment(draft.path)
    assert problem.data["stress"].shape == (18, 2)
    assert problem.run.forward == "incompressible"
    with pytest.raises(InputError, match="is there already"):
        draft_specimen(tmp_path / "test.csv", tmp_path / "test.toml")


def test_states_and_stresses_come_of_one_reading_of_the_table(tmp_path, monkeypatch):
    (tmp_path / "test.csv").write_text(table())
    readings, read_text = [], Path.read_text

    def counted(path, *arguments, **words):
        readings.append(path.name)
        return read_text(path, *arguments, **words)

    monkeypatch.setattr(Path, "read_text", counted)
    draft = draft_specimen(tmp_path / "test.csv", tmp_path / "test.toml")
    assert readings.count("test.csv") == 2  # for the files, and to check what was written
    readings.clear()
    problem = read_experiment(draft.path)
    assert readings.count("test.csv") == 1
    # A table that is edited afterwards is read again.
    (tmp_path / "test.csv").write_text(table(noise=0.1))
    _, data, _ = read_measurements(problem.scene, tmp_path / "test.csv")
    assert np.abs(data["stress"] - problem.data["stress"]).max() > 0.01


def test_a_specimen_is_simulated_state_by_state(tmp_path, monkeypatch, capsys):
    (tmp_path / "test.csv").write_text(table())
    monkeypatch.chdir(tmp_path)
    assert main(["init", "test.csv", "--law", "holzapfel_ogden_isotropic"]) == 0
    capsys.readouterr()
    words = ["simulate", "test_scene.toml", "--theta", f"a={A}", f"b={B}"]
    assert main([*words, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["status"] == "converged"
    data = read_experiment(tmp_path / "test.toml").data["stress"]
    P = np.diagonal(np.array(result["stresses_kPa"]), axis1=1, axis2=2)
    np.testing.assert_allclose(P[:, :2], data, atol=0.02 * data.max())  # kappa is finite
    assert main([*words, "--out", "test.vtu"]) == 2
    assert "is a specimen, which has no mesh" in capsys.readouterr().err
    for words in (
        ["infer", "test_scene.toml", "--out", "run"],
        ["identify", "before", "test_scene.toml"],
    ):
        assert main(words) == 2
        line = capsys.readouterr().err
        assert line.startswith("calibrate: observe nodes: 'test_scene' has no mesh; give --data")


@pytest.mark.parametrize(
    ("law", "lacks"), [("may_newman", "sheets"), ("ogden_1", "fibres"), ("fung_planar", None)]
)
def test_any_law_is_drafted(tmp_path, law, lacks):
    (tmp_path / "test.csv").write_text(table())
    draft = draft_specimen(tmp_path / "test.csv", tmp_path / "test.toml", law=law)
    assert draft.scene.law.name == law
    assert lacks is None or lacks not in draft.scene_path.read_text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stretch_x\n1.0\n1.1\n", "column 'stress_x' is missing"),
        ("stretch_x,stress_x\n1.0,0\n1.1,0\n", "each stress is zero"),
        ("x,y\n1.0,0\n", "no column says how the specimen moves"),
        ("stretch_x,stress_x\n1.0,0\n1.1,1\n1.0,0\n1.2,2\n", "another test under another name"),
    ],
)
def test_wrong_tables_leave_no_files(tmp_path, text, message):
    (tmp_path / "test.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        draft_specimen(tmp_path / "test.csv", tmp_path / "test.toml")
    assert message in str(caught.value)
    assert not list(tmp_path.glob("*.toml"))


@pytest.mark.slow
def test_from_a_table_to_a_verdict(tmp_path):
    (tmp_path / "test.csv").write_text(table(noise=0.3))

    def calibrate(*words):
        call = "import sys; from calibrate.cli import main; sys.exit(main(sys.argv[1:]))"
        done = subprocess.run(
            [sys.executable, "-c", call, *words], capture_output=True, text=True, cwd=tmp_path,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    calibrate("init", "test.csv", "--law", "holzapfel_ogden_isotropic")
    result = json.loads(calibrate("infer", "test.toml", "--out", "run", "--json"))
    assert result["verdict"] == "accepted"
    rows = result["parameters"]
    for name, truth in (("a", A), ("b", B)):
        assert abs(rows[name]["mean"] - truth) < 3.0 * rows[name]["sd"]
    calibrate("report", "run")
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "way from the first state" in page
    assert "The body" not in page


def test_stresses_without_a_unit_are_named(tmp_path):
    (tmp_path / "test.csv").write_text(table().replace("stress_x [kPa]", "stress_x"))
    notes = draft_specimen(tmp_path / "test.csv", tmp_path / "test.toml").notes
    assert any("stress_x without a unit: kPa" in note for note in notes)


TUBE = """protocol,outer_diameter [mm],stretch_axial,pressure [mmHg],force_axial [g]
a,10.9,1.3,14.5,64.4
a,11.1,1.3,25.0,65.2
b,10.5,1.5,24.7,106.1
"""


def test_a_tube_has_its_files_by_one_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tube.csv").write_text(TUBE)
    assert main(["init", "tube.csv", "--tube", "4.6,0.9,0.5", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["states"] == 3
    assert told["parameters"] == ["c", "k_1", "k_2", "angle", "stiffness_2"]
    scene = read_scene(tmp_path / "tube_scene.toml")
    assert scene.tube == em.specimens.Tube(4.6, (0.9, 0.5))
    assert set(np.unique(scene.regions)) == {1, 2}
    assert set(read_experiment(tmp_path / "tube.toml").run.noise) == {"tube_pressure", "tube_force"}
    for words, told in (
        (["tube.csv", "--tube", "4.6"], "layers are ()"),
        (["tube.csv", "--tube", "wide"], "such as --tube 4.2,0.9"),
        (["tube.csv"], "is of a tube (outer_diameter"),
        (["tube.msh", "--tube", "4.6,0.9"], "not for a mesh"),
    ):
        assert main(["init", *words, "--out", "other.toml"]) == 2
        assert told in capsys.readouterr().err


GRIPPED = """law = "holzapfel_ogden_isotropic"
specimen = "test.csv"
grips = {size = [8.0, 4.0, 2.0], cells = 2}

[parameters.a]
unit = "kPa"
range = [2.0, 20.0]

[constants]
b = 5.0
kappa = 500.0
"""


@pytest.fixture
def gripped(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "test.csv").write_text("stretch_x,stress_x [kPa]\n1,0\n1.05,2.1\n1.1,4.9\n")
    (tmp_path / "scene.toml").write_text(GRIPPED)
    return tmp_path


@pytest.mark.slow
def test_what_grips_do_is_learned_by_one_command(gripped, capsys):
    assert main(["train", "scene.toml", "--out", "grips.safetensors", "--simulations", "10"]) == 0
    assert 'learned = "grips.safetensors" under [grips]' in capsys.readouterr().out
    text = GRIPPED.replace("cells = 2", 'cells = 2, learned = "grips.safetensors"')
    (gripped / "scene.toml").write_text(text)
    scene = read_scene(gripped / "scene.toml")
    theta, forward = scene.centre, em.homogeneous(scene)
    (data,) = (cal.stresses(scene, "stress_x")(forward(theta), theta),)
    free = read_scene_without_grips(gripped)
    even = cal.stresses(free, "stress_x")(forward(theta), theta)
    assert float(data[0, 0]) == 0.0
    assert 1.01 < float(data[-1, 0] / even[-1, 0]) < 1.3  # a clamped strip is stiffer


def test_edited_grips_are_another_scene(gripped):
    """To simulators, certificates and the posteriors that a folder keeps."""
    clamped, free = read_scene(gripped / "scene.toml"), read_scene_without_grips(gripped)
    (gripped / "scene.toml").write_text(GRIPPED.replace("cells = 2", "cells = 2, marks = 2.0"))
    by_marks = read_scene(gripped / "scene.toml")
    scenes = clamped, free, by_marks
    assert len({scene.fingerprint for scene in scenes}) == 3
    for scene in scenes:
        assert simulator_of(scene).scene.grips == scene.grips


@pytest.mark.slow
def test_a_posterior_is_refused_after_its_grips_were_edited(gripped, capsys):
    words = [
        "--data",
        "test.csv",
        "--noise",
        "stress=0.1",
        "--forward",
        "incompressible",
        "--no-certify",
    ]
    assert main(["infer", "scene.toml", *words, "--out", "run"]) == 0
    assert main(["report", "run"]) == 0
    (gripped / "scene.toml").write_text(GRIPPED.replace("8.0", "9.0"))
    capsys.readouterr()
    for command in ("certify", "report"):
        assert main([command, "run"]) == 2
        assert "was made for another scene" in capsys.readouterr().err


def read_scene_without_grips(folder):
    (folder / "free.toml").write_text(
        "\n".join(GRIPPED.splitlines()[:2] + GRIPPED.splitlines()[3:])
    )
    return read_scene(folder / "free.toml")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("cells = 2", 'cells = 2, held = "glued"', "grips"),
        ("size = [8.0, 4.0, 2.0]", "size = [8.0, 4.0]", "size"),
        ("cells = 2", "marks = 9.0", "below that of the piece"),
        ("cells = 2", 'learned = "none.safetensors"', "does not exist"),
        ('specimen = "test.csv"', 'mesh = "body.msh"', "supports"),
    ],
)
def test_bad_grips_get_one_line(gripped, capsys, old, new, words):
    (gripped / "scene.toml").write_text(GRIPPED.replace(old, new))
    assert main(["train", "scene.toml", "--out", "grips.safetensors"]) == 2
    found = capsys.readouterr().err.strip()
    assert words in found
    assert len(found.splitlines()) == 1


def test_a_folder_is_no_file_of_grips(gripped, capsys):
    assert main(["train", "scene.toml", "--out", "grips"]) == 2
    assert "NAME.safetensors" in capsys.readouterr().err


def load_control():
    """A test under load control and one under stretch control, of the law of ``table``."""
    rows = ["protocol,applied_x,stretch_x,stretch_y,stress_x [kPa]"]
    s = np.linspace(1.0, 1.2, 5)
    pull = A * np.exp(B * (s**2 + 2.0 / s - 3.0)) * (s - s**-2.0)
    rows += [f"pull,{pull[k]:.12g},{s[k] + 1e-3 * (-1) ** k:.12g},," for k in range(5)]
    stress = A * np.exp(B * (s**2 + s**-2.0 - 2.0)) * (s - s**-3.0)
    rows += [f"strip,,{s[k]:.12g},1,{stress[k] + 0.1 * (-1) ** k:.12g}" for k in range(5)]
    return "\n".join(rows) + "\n"


def test_load_control_has_its_files_by_one_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "test.csv").write_text(load_control())
    words = ["--law", "holzapfel_ogden_isotropic"]
    assert main(["init", "test.csv", *words, "--json"]) == 0
    notes = " ".join(json.loads(capsys.readouterr().out)["notes"])
    for told in ("10 states in 2 tests", "stretch reaches 1.2", "0.3 of a test's largest pull",
                 "applied_x without a unit: kPa"):  # fmt: skip
        assert told in notes
    assert "[grips]" not in (tmp_path / "test_scene.toml").read_text()
    problem = read_experiment(tmp_path / "test.toml")
    assert set(problem.run.noise) == {"stress", "stretch"}
    scene = read_scene(tmp_path / "test_scene.toml")
    assert scene.space.theta({"a": A, "b": B}, "truth is in the ranges").shape == (2,)


@pytest.mark.slow
def test_load_control_has_the_laws_parameters(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "test.csv").write_text(load_control())
    assert main(["init", "test.csv", "--law", "holzapfel_ogden_isotropic"]) == 0
    capsys.readouterr()
    assert main(["infer", "test.toml", "--out", "run", "--no-certify", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["parameters"]
    for name, truth in (("a", A), ("b", B)):
        assert abs(rows[name]["mean"] - truth) < 4.0 * rows[name]["sd"]


def test_a_test_without_any_stretch_is_refused(tmp_path):
    (tmp_path / "test.csv").write_text("applied_x,stretch_x\n0,1\n2,1\n")
    with pytest.raises(InputError, match="each stretch is 1"):
        draft_specimen(tmp_path / "test.csv", tmp_path / "test.toml")


def test_a_specimen_has_the_priors_that_its_scene_states(tmp_path, monkeypatch):
    """Its solver needs no box: the prior is not cut at the range that a training would cover."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "test.csv").write_text(table(noise=0.3))
    assert main(["init", "test.csv", "--law", "holzapfel_ogden_isotropic"]) == 0
    text = (tmp_path / "test_scene.toml").read_text()
    assert "range" not in text
    assert text.count("# CHANGE: a guess") == 2
    a, _ = read_scene(tmp_path / "test_scene.toml").parameters
    problem = read_experiment(tmp_path / "test.toml")
    assert problem.run.prior["median"]["a"] == a.prior.median
    model = model_before_data(problem)
    far = {"a": a.prior.median * np.exp(2.5 * a.prior.log_sd), "b": 2.0}  # of the range, one sd
    assert np.isfinite(model.prior["a"].log_prob(far["a"]))
    assert bool(model.predict(far)[1])
    assert not model.boxed


@pytest.mark.slow
def test_a_specimens_truth_may_be_far_from_its_prior(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "test.csv").write_text(table(noise=0.3))
    assert main(["init", "test.csv", "--law", "holzapfel_ogden_isotropic"]) == 0
    text = (tmp_path / "test_scene.toml").read_text()
    text = re.sub(r"median = [^ ]+ .*\nlog_sd = .*", "median = 1.0\nlog_sd = 1.0", text)
    (tmp_path / "test_scene.toml").write_text(text)
    assert main(["infer", "test.toml", "--out", "run", "--no-certify", "--json"]) == 0
    _, posterior = read_posterior("run")
    for name, truth in (("a", A), ("b", B)):  # at 2.1 and 1.8 sd, the range at one
        row = posterior.summary()[name]
        assert abs(row["mean"] - truth) < 4.0 * row["sd"]


def test_what_grips_do_is_known_in_their_box_only(tmp_path):
    """So the prior is cut there, and the end of the box is one that a posterior may end at."""
    (tmp_path / "test.csv").write_text(table())
    scene = draft_specimen(tmp_path / "test.csv", tmp_path / "test.toml").scene
    learned = GripStresses(np.zeros((1, 4)), np.zeros((1, 18, 3, 3)), 0.0, "")
    gripped = replace(scene, homogeneous=False, grips=Grips((10.0, 10.0, 1.0), learned=learned))
    run = read_experiment(tmp_path / "test.toml").run
    asked = replace(run, prior="box")
    assert without_box(asked, gripped) == (asked, gripped)
    assert without_box(asked, scene)[0].prior["median"]
