import json
from dataclasses import replace

import numpy as np
import pytest

import calibrate as cal
from calibrate.analysis import effects
from calibrate.analysis.effects import WithoutTerms, recommend, tolerances
from calibrate.cli import main
from calibrate.measurements import observations, spread_landmarks
from emulator.core.errors import InputError, SolverError
from emulator.fem import Simulator, sobol
from emulator.scenes.effects import leave_out
from emulator.scenes.loads import Gravity, Traction
from scene_support import block


@pytest.fixture(scope="module")
def pulled():
    """A block pulled hard, whose weight hardly matters."""
    loads = (Traction("right", (1.5, 0.0, 0.0)), Gravity(density=0.1))
    return block(loads=loads)


@pytest.fixture(scope="module")
def corners(pulled):
    return cal.landmarks(pulled, spread_landmarks(pulled, 4, 0))


@pytest.fixture(scope="module")
def loose(pulled, corners):
    """With factorisations for a clock, since a solve takes a millisecond of a busy machine."""
    clocked = effects._clocked

    def counted(simulator, theta):
        _, solution = clocked(simulator, theta)
        return float(solution.factorisations), solution

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(effects, "_clocked", counted)
        return recommend(pulled, corners, 2.0, samples=2)


@pytest.mark.slow
def test_changes_are_those_of_fem(pulled, corners, loose):
    alone = {each.left_out: each for each in loose.alone}
    assert set(alone) == {("finite strain",), ("gravity",)}
    comparison = WithoutTerms(pulled, observations(corners), 2, 0)
    scene = pulled
    thetas = sobol(scene, 2, 0)
    with_it, without = Simulator(scene), Simulator(leave_out(scene, ["gravity"]))
    expected = 0.0
    for theta in thetas:
        u, v = with_it(theta)[corners.nodes], without(theta)[corners.nodes]
        change = np.asarray(corners(u, theta) - corners(v, theta))
        expected = max(expected, np.linalg.norm(change, axis=1).max())
    assert alone["gravity",].changes["displacement"] == pytest.approx(expected, rel=1e-6)
    assert comparison.without(()).changes == {"displacement": 0.0}
    assert 0.0 < alone["gravity",].changes["displacement"] < 1e-3
    assert alone["finite strain",].changes["displacement"] > 0.02


def test_what_saves_time_goes_and_the_tolerance_is_kept(loose):
    # Small strains need one factorisation.
    assert "finite strain" in loose.left_out
    assert loose.chosen.ratio < 1.0
    assert loose.chosen.changes["displacement"] <= 2.0
    assert loose.scene.law.name == "small_strain"


def test_an_effect_that_matters_stays(pulled, corners):
    tight = recommend(pulled, corners, 1e-2, samples=2)
    assert "finite strain" not in tight.left_out
    assert tight.chosen.changes["displacement"] <= 1e-2


def test_a_choice_that_does_not_hold_elsewhere_is_taken_back(pulled, corners, monkeypatch):
    first = WithoutTerms(pulled, observations(corners), 2, 0)
    lying = WithoutTerms.without

    def without(self, names):
        found = lying(self, names)
        chosen_at = np.array_equal(self._thetas, first._thetas)
        return replace(found, changes={"displacement": 0.0}) if chosen_at else found

    monkeypatch.setattr(WithoutTerms, "without", without)
    found = recommend(pulled, corners, 1e-2, samples=2)
    assert "finite strain" not in found.left_out


def test_bad_input(pulled, corners):
    seen = observations(corners)
    assert tolerances(["0.5mm"], seen) == {"displacement": 0.5}
    assert tolerances(["5e-1 mm"], seen) == {"displacement": 0.5}
    for word, message in (
        ("mm", "write a number and its unit"),
        ("0.5", "tolerance in 1: nothing observed has that unit; observed: displacement in mm"),
        ("0.5mL", "tolerance in mL: nothing observed"),
    ):
        with pytest.raises(InputError, match=message):
            tolerances([word], seen)
    with pytest.raises(InputError, match="none for displacement; give one in mm"):
        tolerances([], seen)
    with pytest.raises(InputError, match="must be above 0"):
        recommend(pulled, corners, 0.0)
    with pytest.raises(InputError, match="give 2 or more"):
        recommend(pulled, corners, 1.0, samples=1)
    bare = replace(block(loads=(Gravity(),)), law=replace(pulled.law, simpler=()))
    with pytest.raises(InputError, match="no effect that it can do without"):
        recommend(bare, corners, 1.0)


@pytest.mark.slow
def test_a_scene_that_fem_does_not_solve(pulled, corners):
    heavy = replace(pulled, loads=(Traction("right", (-1e6, 0.0, 0.0)), Gravity()))
    with pytest.raises(SolverError, match="effects: FEM of scene 'block'"):
        recommend(heavy, corners, 1.0, samples=2)


@pytest.mark.slow
def test_command(capsys):
    words = ["effects", "once_clamped_beam", "--observe", "landmarks:4", "--samples", "2"]
    assert main([*words, "--tolerance", "1mm", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["leave_out"] == []
    assert found["alone"][0]["changes"]["displacement"] > 1.0
    assert main([*words, "--tolerance", "1mL"]) == 2
    assert "nothing observed has that unit" in capsys.readouterr().err
