"""Options of ``calibrate train``."""

from calibrate.cli import main
from emulator.training.trainer import RECIPES


def test_the_choices_are_the_recipes(capsys):
    assert main(["train", "once_clamped_beam", "--recipe", "luck", "--out", "x"]) == 2
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1
    assert all(name in said for name in RECIPES)
