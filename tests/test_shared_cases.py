"""Inputs as users bring them, by the command line."""

import json

import numpy as np
import pytest

from calibrate.cli import main
from cli_support import answer, complaint


@pytest.mark.slow
def test_a_round_body_without_sets_is_held(cases, tmp_path, capsys):
    out = tmp_path / "organ.toml"
    code, told = answer(capsys, "init", cases / "no_sets_round_body/organ.msh", "--out", out)
    assert code == 0
    assert any("held where x is between" in note for note in told["notes"])
    assert "[node_sets.held]   # CHANGE" in out.read_text()
    code, solved = answer(capsys, "simulate", out)
    assert code == 0
    (force,) = solved["reactions"].values()
    np.testing.assert_allclose(force, [0.0, 0.0, 1646.4], atol=0.1)  # its weight
    assert main(["check", "mesh", str(out), "--out", str(tmp_path / "mesh")]) == 0


@pytest.mark.parametrize("name", ["plain", "curve", "face"])
def test_entities_reversed_in_their_group(cases, tmp_path, capsys, name):
    mesh = cases / f"negative_physical_tag/{name}.msh"
    code, told = answer(capsys, "init", mesh, "--out", tmp_path / "block.toml")
    assert code == 0
    assert told["facet_sets"] == {"left": 90, "right": 90}
    assert told["node_sets"]["edge"] == 13
    assert "held at 'left'" in told["notes"]


@pytest.mark.parametrize(
    ("name", "law"), [("converted", "neo_hookean"), ("tags_and_fiber", "holz")]
)
def test_sets_from_whole_numbers(cases, tmp_path, capsys, name, law):
    mesh = cases / f"integer_tags/{name}.vtu"
    code, told = answer(capsys, "init", mesh, "--out", tmp_path / "block.toml")
    assert code == 0
    assert told["facet_sets"] == {"1": 90, "2": 90}
    assert told["law"].startswith(law)


def test_all_saved_by_gmsh(cases, tmp_path, capsys):
    mesh = cases / "gmsh_save_all/saveall_41.msh"
    code, told = answer(capsys, "init", mesh, "--out", tmp_path / "41.toml")
    assert (code, told["facet_sets"]) == (0, {"fixed": 90})
    mesh = cases / "gmsh_save_all/saveall_22.msh"
    code, told = answer(capsys, "init", mesh, "--out", tmp_path / "22.toml")
    assert (code, told["facet_sets"]) == (0, {})
    assert any("save them with Mesh.SaveAll = 0" in note for note in told["notes"])


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("A_plain", {"loaded"}),
        ("B_nset_on_node", set()),
        ("G_surface", {"load"}),
        ("H_setofsets", {"a", "b"}),
    ],
)
def test_sets_of_abaqus(cases, tmp_path, capsys, name, more):
    mesh = cases / f"abaqus_sets/{name}.inp"
    assert main(["init", str(mesh), "--out", str(tmp_path / "lines.toml")]) == 0
    assert "fixed (25 nodes)" in capsys.readouterr().out
    code, told = answer(capsys, "init", mesh, "--out", tmp_path / "block.toml")
    assert code == 0
    assert set(told["node_sets"]) == {"fixed", *more}
    assert told["node_sets"]["fixed"] == 25
    assert "held at 'fixed'" in told["notes"]


@pytest.mark.slow
def test_a_corner_of_a_guessed_box_is_no_knowledge(cases, tmp_path, capsys):
    """Two volumes of a ventricle that is stiffer than the range of a_f allows."""
    words = ["left_ventricle", "--data", cases / "box_edge/volumes.csv", "--noise", "volume=3"]
    out = tmp_path / "run"
    code, told = answer(capsys, "infer", *words, "--no-certify", "--out", out)
    assert code == 0
    assert any("a_f at 10.36 kPa" in sentence for sentence in told["warnings"])
    code, told = answer(capsys, "certify", out, "--no-mesh")
    assert (code, told["verdict"]) == (1, "not certified")
    said = json.dumps(told)
    assert "a corner of the box ends the posterior" in said
    assert "--forward rounds" in said
    code, told = answer(capsys, "identify", "after", out)
    assert code == 0
    assert {end["name"] for end in told["box_ends"]} >= {"a", "a_f"}
    assert not any("a_f" in entry["exponents"] for entry in told["combinations"])
    bounded = ["--bounded", "a", "b", "a_f", "b_f"]
    code, told = answer(
        capsys, "infer", *words, "--no-certify", *bounded, "--out", tmp_path / "bounded"
    )
    assert code == 0
    assert not any("the box" in sentence for sentence in told["warnings"])


def wall_between(cases, endocardium, epicardium, axis, height, out, *more):
    """The words of ``calibrate mesh``; the test is skipped without Gmsh."""
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    surfaces = "--endocardium", cases / endocardium, "--epicardium", cases / epicardium
    return "mesh", *surfaces, "--axis", 0, 0, axis, "--base-height", height, "--out", out, *more


@pytest.mark.parametrize("size", [0.7, 1.15, 1.4, 1.7])
def test_rough_surfaces_are_meshed_at_every_size(cases, tmp_path, capsys, size):
    folder, out = "coarse_rough_surfaces", tmp_path / "lv.vtu"
    files = f"{folder}/endo.stl", f"{folder}/epi.stl"
    code, told = answer(capsys, *wall_between(cases, *files, 1, 1.5, out, "--size", size))
    assert code == 0
    assert 0 < told["folded"] < 0.2 * told["elements"]
    assert told["quality"]["jacobian"] > 0.3
    (cavity,) = told["cavities"].values()
    assert cavity["mesh"] == pytest.approx(cavity["surface"], rel=0.01 * size**3)


def test_openings_above_the_base_plane_do_not_count(cases, tmp_path, capsys):
    cavities = []
    for name in ("endo", "endo_closed"):
        files = f"two_valves/{name}.stl", "two_valves/epi.stl"
        words = wall_between(cases, *files, 1, 8, tmp_path / f"{name}.vtu")
        code, told = answer(capsys, *words)
        assert code == 0
        assert told["warnings"] == []
        cavities += told["cavities"].values()
    assert cavities[0] == pytest.approx(cavities[1], rel=1e-9)
    assert cavities[0]["surface"] == pytest.approx(52.6, rel=0.01)  # closed form, mL
    words = wall_between(cases, *files, 1, 80, tmp_path / "beside.vtu")
    assert "--base-height between -40 and 40 mm" in complaint(capsys, *words)


def test_an_axis_the_wrong_way_round_is_questioned(cases, tmp_path, capsys):
    files = "two_valves/endo_closed.stl", "two_valves/epi.stl"
    words = wall_between(cases, *files, -1, -8, tmp_path / "cap.vtu")
    code, told = answer(capsys, *words)
    assert code == 0
    assert told["cut_off"] == pytest.approx(58.0, abs=0.1)
    assert told["cut_off_ml"] == pytest.approx(131.7, rel=0.01)
    doubt = told["warnings"][0]
    assert "the base plane cuts off 131.7 mL and leaves 80.9" in doubt
    assert "--axis 0 0 1 --base-height 8" in doubt
    assert main(list(map(str, words))) == 0
    assert doubt in capsys.readouterr().out


@pytest.mark.slow
def test_forces_of_an_emulator_that_is_right_in_displacement(cases, tmp_path, capsys):
    """Training, evaluation, inference and certificate name the map: 1.36 +- 0.23 for 1."""
    case, out = cases / "uniaxial_reaction", tmp_path / "post"
    emulator = str(tmp_path / "emulator")
    assert main(["train", str(case / "ho.toml"), "--recipe", "mechanics", "--out", emulator]) == 0
    assert "at worst 1.4 N of up to 1.7 N in the force of a" in capsys.readouterr().out
    _, errors = answer(capsys, "evaluate", emulator, "--against", "fem", "--cases", "10")
    assert errors["err_u"]["max"] < 0.1 < errors["err_R"]["max"]
    assert errors["units"]["err_R"] == "N"
    words = ["infer", case / "ho.toml", "--data", case / "force.csv", "--noise", "0.02"]
    words += ["--emulator", emulator, "--draws", "200", "--out", out]
    code, told = answer(capsys, *words, "--warmup", "200", "--chains", "2")
    assert code == 1
    assert told["warnings"][0].startswith("the forward map misses FEM by ")
    assert "--forward corrected" in told["warnings"][0]
    assert "for which sampler" not in " ".join(told["warnings"])
    certificate = told["certificate"]
    assert told["verdict"] == "reweight"  # to FEM's posterior, which has the truth
    assert certificate["mean_fem"]["a"] == pytest.approx(1.0, abs=0.1)
    assert certificate["findings"][0].startswith("mean of a moves by ")
    assert any(f.startswith("the forward map misses FEM by ") for f in certificate["findings"])
    words += ["--force", "--no-certify", "--forward", "corrected", "--sampler", "laplace"]
    code, told = answer(capsys, *words)
    assert (code, told["warnings"]) == (0, [])
    assert told["parameters"]["a"]["mean"] == pytest.approx(1.0, abs=0.05)
