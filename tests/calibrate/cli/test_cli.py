"""The command line in process: results as JSON."""

import json
from dataclasses import replace

import meshio
import numpy as np
import pytest

import emulator as em
from calibrate.cli import COMMANDS, build_parser, main
from calibrate.cli.run_words import problem_of
from calibrate.cli.words import seconds
from cli_support import SCENE, answer, complaint, write_block
from emulator.core.errors import InputError


@pytest.fixture
def block(tmp_path):
    return write_block(tmp_path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("90s", 90.0), ("15m", 900.0), ("2h", 7200.0), ("1h30m", 5400.0), ("1.5m", 90.0)],
)
def test_durations(text, expected):
    assert seconds(text) == expected


def test_scenes(capsys):
    code, rows = answer(capsys, "scenes")
    assert code == 0
    beam = next(row for row in rows if row["name"] == "once_clamped_beam")
    assert (beam["nodes"], beam["elements"], beam["emulator_shipped"]) == (1025, 480, True)
    others = ["once_clamped_beam_physics", "once_clamped_beam_series"]
    assert beam["emulators"] == ["once_clamped_beam", *others]
    assert main(["scenes"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) < 80
    assert "stiffness_1 ... stiffness_17 0.5 to 2" in "\n".join(lines)


def test_one_scene_has_the_cards_of_its_emulators(capsys):
    code, (beam,) = answer(capsys, "scenes", "once_clamped_beam")
    assert code == 0
    assert [card["name"] for card in beam["cards"]] == beam["emulators"]
    assert beam["cards"][2]["fem_runs"] == 201
    code, (card,) = answer(capsys, "scenes", "ventricle_family")
    assert (code, card["scene"], card["bodies"]) == (0, "left_ventricle", 789)
    assert main(["scenes", "once_clamped_beam"]) == 0
    text = capsys.readouterr().out
    assert "Newton's step at unseen theta: max 1.6e-07 mm" in text
    assert text.count("licence  MIT") == 3
    assert answer(capsys, "scenes", "turned_beam")[1][0]["cards"] == []
    assert "did you mean 'once_clamped_beam'?" in complaint(capsys, "scenes", "once_clamped")


def test_simulate(capsys, block, tmp_path):
    out = tmp_path / "u.vtu"
    code, result = answer(capsys, "simulate", block, "--theta", "mu=7", "--out", out)
    assert code == 0
    assert result["status"] == "converged"
    assert result["stable"] is True
    assert result["theta"] == {"mu": 7.0}
    written = meshio.read(out)
    field = written.point_data["displacement"]
    assert np.linalg.norm(field, axis=1).max() == pytest.approx(result["max_displacement"])
    assert {name: data[0].shape[1:] for name, data in written.cell_data.items()} == {
        "J": (),
        "cauchy_stress": (9,),
        "green_lagrange": (9,),
    }
    assert written.cell_data["J"][0].min() == pytest.approx(result["J_range"][0])
    # Half the stiffness, about twice the sag.
    _, soft = answer(capsys, "simulate", block, "--theta", "mu=14", "--load-steps", 2)
    assert 1.3 < result["max_displacement"] / soft["max_displacement"] < 2.2


@pytest.mark.slow
def test_unload(capsys, block, tmp_path):
    out = tmp_path / "rest"
    code, result = answer(capsys, "unload", block, "--theta", "mu=7", "--out", out)
    assert code == 0
    assert result["status"] == result["reloaded"]["status"] == "converged"
    assert result["reloaded"]["missed"] < 1e-8
    assert result["largest_displacement"] > 0.0
    # The mesh that was written, loaded, is the one that was read.
    text = block.read_text().replace("block.vtu", str(out / "unloaded.vtu"))
    (tmp_path / "again.toml").write_text(text)
    _, again = answer(capsys, "simulate", tmp_path / "again.toml", "--theta", "mu=7")
    assert again["max_displacement"] == pytest.approx(result["largest_displacement"], rel=1e-9)
    written = meshio.read(out / "loaded.vtu")
    places = written.points + written.point_data["displacement"]
    np.testing.assert_allclose(places, meshio.read(tmp_path / "block.vtu").points, atol=1e-8)
    assert main(["unload", str(block)]) == 0
    assert "loaded again from rest: converged" in capsys.readouterr().out


@pytest.mark.slow
def test_simulate_under_a_pressure_without_a_potential(capsys, block):
    push = 'kind = "follower_pressure"\nfacet_set = "end"\npressure = 0.1\n'
    plane = '[facet_sets.end]\naxis = "x"\nat = 20.0\n'
    text = SCENE.replace("[constants]", f"{plane}[[loads]]\n{push}[constants]")
    block.write_text(text)
    code, result = answer(capsys, "simulate", block)
    assert code == 0
    assert result["energy"] is None
    assert result["stable"] is None
    assert result["max_displacement"] > 0.0
    block.write_text(text.replace("follower", "cavity"))
    said = complaint(capsys, "simulate", block)
    assert "cavity 'end': rim node" in said
    assert "FollowerPressure" in said


@pytest.mark.parametrize("words", [["-h"], ["-h", "simulate"], ["--no-cache", "--help"]])
def test_help_names_every_command(capsys, words):
    with pytest.raises(SystemExit):
        main(words)
    said = capsys.readouterr().out
    assert all(f"    {name} " in said or f"    {name}\n" in said for name in COMMANDS)


@pytest.mark.slow
def test_train_and_evaluate(capsys, block, tmp_path):
    """The emulator of a scene of the user's own."""
    out = tmp_path / "e"
    code, record = answer(capsys, "train", block, "--simulations", 16, "--out", out)
    assert code == 0
    assert "--recipe mechanics --simulations 16 --seed 0" in record["command"]
    assert {path.name for path in out.iterdir()} == {"emulator.json", "weights.safetensors"}
    code, errors = answer(capsys, "evaluate", out, "--against", "fem", "--cases", 5)
    assert code == 0
    assert errors["cases"] == 5
    assert errors["err_u"]["median"] < 0.1 * errors["max_u"]["median"]


@pytest.mark.slow
def test_infer_and_certify(capsys, block, tmp_path):
    """A scene of the user's own, and a forward map made of FEM runs, which needs no training."""
    words = ["--truth", "mu=9", "--observe", "landmarks:6", "--noise", "0.02"]
    run = [*words, "--forward", "reduced", "--fem-runs", 8, "--warmup", 200, "--draws", 200]
    code, result = answer(capsys, "infer", block, *run, "--no-certify", "--out", tmp_path / "r")
    assert code == 0
    assert (result["verdict"], result["k_hat"]) == ("not certified", None)
    row = result["parameters"]["mu"]
    assert abs(row["mean"] - 9.0) < 4 * row["sd"]
    names = {path.name for path in (tmp_path / "r").iterdir()}
    assert names == {"run.json", "data.csv", "forward.safetensors", "posterior.nc"}
    code, result = answer(capsys, "certify", tmp_path / "r", "--draws", 80)
    assert (code, result["verdict"]) == (1, "not certified")  # a few linear tetrahedra, tight data
    assert "on a finer mesh" in result["certificate"]["reason"]
    code, result = answer(capsys, "certify", tmp_path / "r", "--draws", 80, "--no-mesh")
    assert (code, result["verdict"]) == (0, "accepted")
    assert result["certificate"]["reason"].endswith("on this mesh")
    assert json.loads((tmp_path / "r" / "certificate.json").read_text())["verdict"] == "accepted"
    few = ["certify", tmp_path / "r", "--draws", 40, "--no-mesh"]
    assert answer(capsys, *few)[1]["verdict"] == "undecided"
    code, result = answer(capsys, *few, "--until", "decided", "--at-most", 160)
    assert (code, result["verdict"]) == (0, "accepted")
    assert 40 < result["certificate"]["draws"] <= 160
    assert main(["certify", str(tmp_path / "r"), "--at-most", "160"]) == 2
    assert "--at-most is of --until decided" in capsys.readouterr().err


@pytest.mark.slow
def test_kept_data_is_data_like_any_other(capsys, block, tmp_path):
    """And infer certifies unless told not to."""
    words = ["--truth", "mu=9", "--observe", "landmarks:6", "--noise", "0.02"]
    run = [*words, "--forward", "reduced", "--fem-runs", 8, "--warmup", 200, "--draws", 200]
    code, result = answer(capsys, "infer", block, *run, "--no-certify", "--out", tmp_path / "r")
    assert code == 0
    row = result["parameters"]["mu"]
    code, again = answer(
        capsys, "infer", block, "--data", tmp_path / "r" / "data.csv", "--noise", "0.02",
        *run[6:], "--out", tmp_path / "s",
    )  # fmt: skip
    # The map is right, and the certificate refuses the block's few linear elements.
    findings = again["certificate"]["findings"]
    assert (code, again["verdict"]) == (1, "not certified")
    assert findings[-1].startswith("no mean moves by more than")
    assert all(finding.startswith("on a finer mesh") for finding in findings[:-1])
    assert again["parameters"]["mu"]["mean"] == pytest.approx(row["mean"], abs=row["sd"])


def test_evaluate_against_the_released_solutions(capsys, published, tmp_path):
    folder = published / "OnceClampedBeam"
    # The released elements are linear; those of shipped emulators are quadratic.
    plan = replace(em.recipe("mechanics"), simulations=4)
    trained = em.train(em.scenes.once_clamped_beam(order=1), plan, tmp_path / "training")
    em.save_emulator(trained, tmp_path / "e")
    code, report = answer(capsys, "evaluate", tmp_path / "e", "--against", folder)
    assert code == 0
    assert report["cases"] == 50
    # The paper's medians after a million steps on a GPU (Dalton et al. 2023, Table 1).
    assert report["err_u"]["median"] <= 2.0e-2
    assert report["err_Pi"]["median"] <= 6.6e-2
    assert "is not the scene 'once_clamped_beam'" in complaint(
        capsys, "evaluate", "once_clamped_beam", "--against", folder
    )


def test_no_repeated_option_is_lost(tmp_path, monkeypatch, capsys):
    """argparse keeps the last one alone, in silence."""
    monkeypatch.chdir(tmp_path)
    words = [*INFER_TWICE, "--noise", "volume=20", "--noise", "displacement=0.3"]
    problem = problem_of(build_parser("infer").parse_args(words))
    assert problem.run.noise == {"volume": 20.0, "displacement": 0.3}
    assert problem.run.truth == {"a": 1.0, "b": 2.0, "a_f": 6.0, "b_f": 2.0, "pressure": 1.0}
    for repeated in (["--noise", "volume=3"], ["--truth", "a=1"]):
        with pytest.raises(InputError, match="is given twice"):
            problem_of(build_parser("infer").parse_args([*words, *repeated]))
    assert main([*words, "--seed", "1", "--seed", "2"]) == 2
    assert capsys.readouterr().err.strip().startswith("calibrate: --seed is given twice")


INFER_TWICE = (
    "infer", "left_ventricle", "--truth", "a=1", "b=2", "--truth", "a_f=6", "b_f=2", "pressure=1",
    "--observe", "landmarks:24+volume", "--out", "run",
)  # fmt: skip
