"""``calibrate campaign`` on the command line, and what takes its stores."""

import json

import pytest
import zarr

from calibrate.cli import main
from cli_support import SCENE, answer, complaint, write_block


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    return write_block(tmp_path_factory.mktemp("block"))


@pytest.fixture(scope="module")
def store(block):
    """A campaign of three theta."""
    path = block.parent / "runs.zarr"
    assert main(["campaign", str(block), "--samples", "3", "--out", str(path)]) == 0
    return path


def test_it_counts(capsys, block, store):
    capsys.readouterr()
    code, found = answer(capsys, "campaign", block, "--samples", 3, "--out", store)
    assert code == 0
    assert found["status"] == {"converged": 3}
    assert (found["samples"], found["solved_now"]) == (3, 0)
    assert main(["campaign", str(block), "--samples", "3", "--out", str(store)]) == 0
    assert "3 theta: 3 converged" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--samples", "4"], "has samples 3, not 4"),
        (["--samples", "3", "--seed", "1"], "has seed 0, not 1"),
        (["--samples", "3", "--slopes"], "has sensitivities False, not True"),
        (["--samples", "3", "--load-steps", "2"], "has newton other solver options"),
        (["--samples", "3", "--design", "latin_hypercube"], "has design sobol, not latin"),
    ],
)
def test_another_campaign_is_refused(capsys, block, store, words, message):
    assert message in complaint(capsys, "campaign", block, *words, "--out", store)


def test_stores_that_are_none(capsys, block, store, tmp_path):
    words = ("campaign", block, "--samples", 3, "--out")
    (tmp_path / "file.zarr").write_text("x")
    (tmp_path / "folder.zarr").mkdir()
    zarr.open_group(tmp_path / "other.zarr", mode="w")
    for name in ("file", "folder", "other"):
        said = complaint(capsys, *words, tmp_path / f"{name}.zarr")
        assert said.endswith(f"{name}.zarr is not a campaign's Zarr store")
    assert "must end in .zarr" in complaint(capsys, *words, tmp_path / "runs")
    assert "cannot write to" in complaint(capsys, *words, "/dev/null/runs.zarr")
    other = tmp_path / "scene.toml"
    # The range first: a path may have a 30, too.
    changed = SCENE.replace("30", "40")
    other.write_text(changed.replace("block.vtu", str(block.parent / "block.vtu")))
    said = complaint(capsys, "campaign", other, "--samples", 3, "--out", store)
    assert "is of scene 'scene' with another mesh, law, load or range" in said


@pytest.mark.slow
def test_training_takes_its_runs(capsys, block, tmp_path):
    """The emulator of a campaign is the one of training's own runs at the same theta."""
    stored, plain = str(tmp_path / "runs.zarr"), str(tmp_path / "plain.zarr")
    made = ["--samples", "10", "--design", "sobol_corners"]
    assert main(["campaign", str(block), *made, "--slopes", "--out", stored]) == 0
    assert main(["campaign", str(block), *made, "--out", plain]) == 0
    train = ("train", block, "--recipe", "mechanics")
    capsys.readouterr()
    code, own = answer(capsys, *train, "--simulations", 10, "--out", tmp_path / "own")
    assert code == 0
    code, taken = answer(capsys, *train, "--campaign", stored, "--out", tmp_path / "taken")
    assert code == 0
    assert taken["plan"]["simulations"] == 10
    assert taken["command"].endswith("--campaign STORE.zarr --out DIR")
    assert own["discrepancy"]["on"] == taken["discrepancy"]["on"]
    predicted = [
        answer(capsys, "predict", tmp_path / name, "--theta", "mu=7")[1]
        for name in ("own", "taken")
    ]
    heights = [found["max_displacement"] for found in predicted]
    assert heights[0] == pytest.approx(heights[1], rel=1e-9)
    said = complaint(capsys, *train, "--campaign", plain, "--out", tmp_path / "x")
    assert "needs slopes, which the campaign lacks" in said
    more = ("--campaign", stored, "--simulations", 11)
    said = complaint(capsys, *train, *more, "--out", tmp_path / "x")
    assert "11 simulations of a campaign with 10" in said
    paper = ("train", block, "--recipe", "paper", "--campaign", stored, "--out", tmp_path / "x")
    assert "takes no FEM runs, so no campaign" in complaint(capsys, *paper)
    assert json.loads((tmp_path / "taken" / "emulator.json").read_text())
