"""Options of ``calibrate train``."""

import pytest

from calibrate.cli import main
from emulator.training.objectives import OBJECTIVES
from emulator.training.trainer import RECIPES


@pytest.mark.parametrize(("option", "names"), [("--recipe", RECIPES), ("--objective", OBJECTIVES)])
def test_the_choices_are_those_of_the_plan(capsys, option, names):
    assert main(["train", "once_clamped_beam", option, "luck", "--out", "x"]) == 2
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1
    assert all(name in said for name in names)
