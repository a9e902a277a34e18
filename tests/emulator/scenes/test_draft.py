"""First scene files: what is recognised, what is guessed and said, what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import lognorm

from calibrate.cli import main
from emulator.core.errors import InputError
from emulator.geometry.generators.box import box
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.io import write_mesh
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_quadratic
from emulator.mechanics.laws import LAWS
from emulator.scenes.draft import draft_scene
from emulator.scenes.fibre_rules import Helix
from emulator.scenes.loads import CavityPressure, FollowerPressure, Gravity
from emulator.scenes.tissue_priors import OF_LAWS


@pytest.fixture
def ventricle_file(tmp_path):
    write_mesh(tmp_path / "lv.msh", human_ventricle(4, 8, 1))
    return tmp_path / "lv.msh"


def test_a_ventricle_of_named_groups(ventricle_file):
    made = draft_scene(ventricle_file, ventricle_file.with_suffix(".toml"))
    scene = made.scene
    assert scene.law.name == "holzapfel_ogden"
    assert scene.loads == (CavityPressure("endocardium"),)
    assert scene.parameter_names == ("a", "b", "a_f", "b_f", "pressure")
    reference, _ = Helix((60.0, -60.0)).directions(to_quadratic(human_ventricle(4, 8, 1)))
    # Coordinates go through a file of text.
    np.testing.assert_allclose(np.abs(scene.fibres), np.abs(reference), atol=1e-6)
    assert "its walls are named" in " ".join(made.notes)
    text = made.path.read_text()
    assert "range = " not in text
    assert "CHANGE: " not in text  # nothing was guessed
    for parameter in scene.parameters:  # the range follows from the prior, which has its source
        prior, sides = parameter.prior, np.exp([-parameter.prior.log_sd, parameter.prior.log_sd])
        np.testing.assert_allclose([parameter.low, parameter.high], prior.median * sides)
        assert "human left ventricles" in prior.source
    assert "#   endocardium: " in text


def test_metres_are_seen_and_written_in_mm(tmp_path):
    mesh = human_ventricle(4, 8, 1)
    write_mesh(tmp_path / "lv.vtu", replace(mesh, nodes=0.001 * mesh.nodes))
    made = draft_scene(tmp_path / "lv.vtu", tmp_path / "new" / "lv.toml")
    assert "taken to be m" in made.notes[0]
    corners = made.scene.mesh.nodes[: len(mesh.nodes)]  # made quadratic, they come first
    np.testing.assert_allclose(corners, mesh.nodes, rtol=1e-6, atol=1e-9)
    assert (tmp_path / "new" / "lv_mm.vtu").is_file()
    write_mesh(tmp_path / "cm.vtu", replace(mesh, nodes=0.1 * mesh.nodes))
    said = draft_scene(tmp_path / "cm.vtu", tmp_path / "cm.toml")
    assert "if it is in cm, give --unit cm" in said.notes[0]
    in_cm = draft_scene(tmp_path / "cm.vtu", tmp_path / "cm2.toml", unit="cm")
    corners = in_cm.scene.mesh.nodes[: len(mesh.nodes)]
    np.testing.assert_allclose(corners, mesh.nodes, rtol=1e-6, atol=1e-9)


def test_a_rim_that_is_not_held_takes_a_follower_pressure(tmp_path):
    mesh = human_ventricle(4, 8, 1)
    walls = {name: rows for name, rows in mesh.facet_sets.items() if name != "base"}
    sets = {"apex fixed": np.array([int(np.argmin(mesh.nodes[:, 2])), 0, 5, 20, 30])}
    write_mesh(tmp_path / "lv.vtu", replace(mesh, node_sets=sets, facet_sets=walls))
    made = draft_scene(tmp_path / "lv.vtu", tmp_path / "lv.toml")
    assert made.scene.loads == (FollowerPressure("endocardium"),)
    assert any("not the load 'cavity_pressure'" in note for note in made.notes)


def test_a_bare_block_hangs_by_its_end(tmp_path):
    mesh = replace(box((40.0, 10.0, 10.0), (4, 2, 2)), node_sets={}, facet_sets={})
    write_mesh(tmp_path / "block.vtu", mesh)
    made = draft_scene(tmp_path / "block.vtu", tmp_path / "block.toml")
    assert made.scene.law.name == "neo_hookean"
    assert isinstance(made.scene.loads[0], Gravity)
    assert any("held where x is least, 0 mm; change it" in note for note in made.notes)
    assert any("own weight along -z is the load" in note for note in made.notes)
    assert not any("not used" in note for note in made.notes)
    assert made.scene.held[:, 0].sum() == 25  # made quadratic
    other = draft_scene(tmp_path / "block.vtu", tmp_path / "other.toml", law="neo_hookean_E_nu")
    nu = other.scene.parameters[1]
    assert (nu.name, nu.low < nu.high < 0.5) == ("nu", True)
    assert nu.prior is None
    text = (tmp_path / "other.toml").read_text()
    assert text.count("# CHANGE: what you think possible") == 1  # of nu
    assert text.count("# CHANGE: a guess") == 1  # of E
    assert other.scene.parameters[0].prior.source == "a guess: log-sd 1"


def test_sets_that_are_not_used_are_named(tmp_path):
    write_mesh(tmp_path / "block.vtu", box((40.0, 10.0, 10.0), (4, 2, 2)))
    made = draft_scene(tmp_path / "block.vtu", tmp_path / "block.toml")
    (note,) = (note for note in made.notes if "not used" in note)
    assert "right, front, back, bottom, top; a force on one" in note
    assert 'kind = "traction"' in note
    assert note in (tmp_path / "block.toml").read_text()


def test_command_and_bad_input(ventricle_file, capsys):
    assert main(["init", str(ventricle_file), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["parameters"] == ["a", "b", "a_f", "b_f", "pressure"]
    assert set(told["facet_sets"]) == {"endocardium", "epicardium", "base"}
    folder = ventricle_file.parent
    (folder / "empty.msh").touch()
    for words, message in (
        ([str(ventricle_file)], "is there already"),
        ([str(folder / "none.msh")], "none.msh"),
        ([str(folder)], "is a folder; name a file in it"),
        (["."], "is a folder; name a file in it"),
        ([str(folder / "empty.msh")], "is empty"),
        ([str(ventricle_file), "--out", "scene.json"], "must end in .toml"),
        ([str(ventricle_file), "--out", str(folder / "b.toml"), "--unit", "ft"], "known: mm, cm"),
        ([str(ventricle_file), "--out", str(folder / "c.toml"), "--law", "hooke"], "is unknown"),
    ):
        assert main(["init", *words]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not (folder / "b.toml").exists()
    assert not (folder / "c.toml").exists()
    with pytest.raises(InputError, match="unit 'ft'"):
        draft_scene(ventricle_file, folder / "d.toml", unit="ft")


def test_linear_tetrahedra_are_kept_from_locking(tmp_path, monkeypatch):
    mesh = human_ventricle(4, 8, 1)
    write_mesh(tmp_path / "lv.vtu", mesh)
    made = draft_scene(tmp_path / "lv.vtu", tmp_path / "lv.toml")
    assert made.scene.mesh.order == 2
    assert "linear tetrahedra, which lock" in " ".join(made.notes)
    monkeypatch.setattr("emulator.scenes.draft._MOST_QUADRATIC", 100)
    large = draft_scene(tmp_path / "lv.vtu", tmp_path / "large.toml").scene
    assert (large.mesh.order, large.dilatation) == (1, "patch")
    write_mesh(tmp_path / "quadratic.vtu", to_quadratic(mesh))
    said = draft_scene(tmp_path / "quadratic.vtu", tmp_path / "quadratic.toml")
    assert "lock" not in " ".join(said.notes)


def test_round_bodies_and_loose_parts_are_held(tmp_path):
    """A ball of tetrahedra about its centre has one node at each end; a copy of it is beside it."""
    block = box((2.0, 2.0, 2.0), (6, 6, 6))
    centred = block.nodes - 1.0
    cube, ball = np.abs(centred).max(axis=1), np.linalg.norm(centred, axis=1)
    nodes = 30.0 * centred * (cube / np.where(ball > 0.0, ball, 1.0))[:, None]
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    nodes = nodes @ turn
    one = replace(block, nodes=nodes, node_sets={}, facet_sets={})
    two = Mesh(
        np.concatenate([nodes, nodes + [100.0, 0.0, 0.0]]),
        np.concatenate([block.elements, block.elements + len(nodes)]),
    )
    tip = replace(one, node_sets={"fixed tip": np.array([0])})
    for name, mesh, count in (("one", one, 1), ("two", two, 2), ("tip", tip, 1)):
        write_mesh(tmp_path / f"{name}.vtu", mesh)
        made = draft_scene(tmp_path / f"{name}.vtu", tmp_path / f"{name}.toml")
        notes = [note for note in made.notes if "held where x is between" in note]
        assert len(notes) == count
        assert made.path.read_text().count("# CHANGE: ") >= count
    assert "'fixed tip' alone leaves the body free to turn or move" in notes[0]


def test_large_bodies_get_moduli_that_stand_their_weight(tmp_path):
    write_mesh(tmp_path / "beam.vtu", replace(box((400.0, 20.0, 20.0), (8, 1, 1)), node_sets={}))
    made = draft_scene(tmp_path / "beam.vtu", tmp_path / "beam.toml")
    prior = made.scene.parameters[0].prior
    assert prior.median == pytest.approx(50 * np.sqrt(3.5 * 10.0), rel=0.02)
    assert (prior.log_sd, prior.source) == (1.0, "a guess, times 50 to stand its weight: log-sd 1")


@pytest.mark.parametrize("law", LAWS)
def test_every_law_has_priors_that_a_scene_takes(tmp_path, law):
    """Published ones name parameters of the law; a scene with them is read again."""
    assert set(OF_LAWS.get(law, {})) <= set(LAWS[law].parameters) - {"kappa"}
    mesh = box((4.0, 1.0, 1.0), (4, 2, 2))
    along, across = (np.tile(d, (len(mesh.elements), 1)) for d in np.eye(3)[:2])
    write_mesh(tmp_path / "b.vtu", mesh, along, across)
    scene = draft_scene(tmp_path / "b.vtu", tmp_path / "b.toml", law=law).scene
    of = {parameter.name: parameter.prior for parameter in scene.parameters}
    for name, prior in OF_LAWS.get(law, {}).items():
        assert (of[name].median, of[name].log_sd) == pytest.approx((prior.median, prior.log_sd))
        assert of[name].source == prior.source
    positive = {q.name for q in scene.law.quantities if (q.low, q.high) == (0.0, np.inf)}
    assert {name for name, prior in of.items() if prior is not None} == positive - {"kappa"}


def test_a_published_mean_and_sd_are_those_of_the_log_normal():
    """Against SciPy's, to the three digits that are written."""
    for name, mean, sd in (("C", 3.0, 1.7), ("b_f", 25.0, 14.0), ("b_t", 9.0, 5.0)):
        prior = OF_LAWS["guccione"][name]
        exact = lognorm(prior.log_sd, scale=prior.median)
        assert (exact.mean(), exact.std()) == pytest.approx((mean, sd), rel=0.02)


def test_a_refused_draft_leaves_no_file(tmp_path, capsys):
    mesh = replace(box((4.0, 1.0, 1.0), (4, 2, 2)), node_sets={}, facet_sets={})
    fibres = np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1))
    write_mesh(tmp_path / "b.vtu", mesh, fibres)
    for law, message in (
        ("hooke", "'hooke' is unknown"),
        ("holzapfel_ogden_orthotropic", "sheets"),
    ):
        assert main(["init", str(tmp_path / "b.vtu"), "--unit", "cm", "--law", law]) == 2
        line = capsys.readouterr().err
        assert message in line
        assert "b.toml" not in line
        assert [path.name for path in tmp_path.iterdir()] == ["b.vtu"]
