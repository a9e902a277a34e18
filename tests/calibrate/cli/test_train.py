"""Options of ``calibrate train``."""

from calibrate.cli import main
from calibrate.cli.commands.train import _distance
from emulator.training.trainer import RECIPES


def test_the_choices_are_the_recipes(capsys):
    assert main(["train", "once_clamped_beam", "--recipe", "luck", "--out", "x"]) == 2
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1
    assert all(name in said for name in RECIPES)


def test_what_a_network_says_of_its_error():
    known = {
        "theta": 16,
        "known": 15,
        "error_mm": {"median": 1.23e-3, "max": 0.0456},
        "energy_percent": {"median": 2.3e-4, "max": 0.1},
    }
    text = _distance(known)
    assert "by Newton's step at 15 of 16 theta drawn anew: 0.0012 mm, 0.046 mm at worst" in text
    assert "0.0002 % above the least; not known at 1, where it is larger" in text
    assert "not known" not in _distance(known | {"known": 16})
    assert "not known by Newton's step at any of 16" in _distance({"theta": 16, "known": 0})


def test_a_training_without_a_checkpoint_is_not_resumed(capsys, tmp_path):
    """Also with a new budget, which is the one option beside --resume."""
    again = ["train", "twisting_cube", "--resume", "--out", str(tmp_path)]
    assert main([*again, "--budget", "5m"]) == 2
    said = capsys.readouterr().err
    assert "nothing to resume" in said
    assert len(said.strip().splitlines()) == 1
    assert main([*again, "--steps", "5"]) == 2
    assert "--steps has no effect with --resume" in capsys.readouterr().err
