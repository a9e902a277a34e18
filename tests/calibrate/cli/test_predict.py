import json
from types import SimpleNamespace

import jax.numpy as jnp
import meshio
import numpy as np
import pytest

import emulator as em
from calibrate.cli import main
from calibrate.cli.commands.prediction import prediction_summary
from calibrate.cli.output import volume_lines
from emulator.fem.outcome import cavity_volumes
from emulator.geometry.facets import Cavity

CENTRE = ("mu=75", "lam=60")


def answer(capsys, *words):
    code = main(["predict", "once_clamped_beam", *map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_inside_the_box(capsys, tmp_path):
    trained = em.load("once_clamped_beam")
    u = trained.cache()(trained.scene.theta(mu=75.0, lam=60.0))
    out = tmp_path / "u.vtu"
    code, result = answer(capsys, "--theta", *CENTRE, "--out", out)
    assert code == 0
    assert result["trusted"]
    assert result["guard"] == ""
    assert result["error"] is None
    assert result["max_displacement"] == pytest.approx(float(jnp.linalg.norm(u, axis=1).max()))
    np.testing.assert_allclose(meshio.read(out).point_data["displacement"], u)


@pytest.mark.slow
def test_error_bar_against_fem(capsys):
    trained = em.load("once_clamped_beam")
    theta = trained.scene.theta(mu=75.0, lam=60.0)
    true = np.linalg.norm(trained.cache()(theta) - em.Simulator(trained.scene)(theta), axis=1)
    code, result = answer(capsys, "--theta", *CENTRE, "--error-bar")
    assert code == 0
    assert result["error"]["median_mm"] == pytest.approx(np.median(true), rel=0.1)
    assert result["error"]["max_mm"] == pytest.approx(true.max(), rel=0.1)
    assert 0.0 < result["error"]["energy_gap_percent"] < 1.0
    said = prediction_summary(result)
    assert "estimated error: median " in said
    assert "not to be trusted" not in said


def test_outside_the_box(capsys):
    code, result = answer(capsys, "--theta", "mu=130", "lam=60")
    assert code == 1
    assert not result["trusted"]
    assert result["guard"] == "parameter 'mu' is 130 kPa, outside 50 to 100"
    assert main(["predict", "once_clamped_beam", "--theta", "mu=130", "lam=60"]) == 1
    assert "not to be trusted: parameter 'mu' is 130 kPa" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--theta", "mu=75"), "no value for parameter 'lam'"),
        (("--theta", "mu=75", "lam=60", "nu=1"), "has no parameter 'nu'"),
        (("--theta", "mu=nan", "lam=60"), "parameter 'mu' is nan; give a finite number"),
        (("--out", "u.vtk"), "must end in .vtu"),
    ],
)
def test_bad_input(capsys, words, message):
    assert main(["predict", "once_clamped_beam", *words]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_cavities():
    scene = em.scenes.left_ventricle(rings=2, around=6, layers=1, order=1)
    u = jnp.zeros(scene.held.shape)
    cavity = Cavity(scene.mesh, "endocardium")
    volume = float(cavity(u[cavity.nodes]))
    assert cavity_volumes(scene, u) == {
        "endocardium": {
            "rest_ml": pytest.approx(volume), "volume_ml": pytest.approx(volume), "error_ml": None
        }
    }  # fmt: skip
    estimate = SimpleNamespace(valid=True, of=lambda quantity: quantity(u) - volume + 2.0)
    found = cavity_volumes(scene, u, estimate.of)
    assert found["endocardium"]["error_ml"] == pytest.approx(2.0)
    (line,) = volume_lines(found)
    assert line == f"cavity 'endocardium': {volume:.6g} mL, at rest {volume:.6g} mL, error +2 mL"
