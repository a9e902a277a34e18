"""The command's work, on a coarse beam with a small network that is off by about 0.1 mm."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import emulator as em
from calibrate.analysis.evaluation import run_evaluation
from calibrate.cli import main
from emulator.core.errors import InputError
from emulator.fem.campaign.designs import fem_reference
from emulator.surrogates import Emulator, load, save_emulator
from emulator.surrogates.taylor import constant
from network_support import untrained


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    scene = em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)
    centre = np.asarray(em.Simulator(scene)(scene.centre))
    series = constant(np.full(2, 0.5), centre)
    path = tmp_path_factory.mktemp("emulator")
    network = replace(untrained(scene).network, scale=np.full(3, 0.1))
    save_emulator(Emulator(scene, taylor=series, network=network), path)
    return str(path)


@pytest.fixture(scope="module")
def reference(folder):
    return fem_reference(em.Simulator(load(folder).scene), 3)


@pytest.mark.slow
def test_newton_steps_square_the_error(folder, reference, monkeypatch):
    monkeypatch.setattr("calibrate.analysis.evaluation.fem_reference", lambda *_, **__: reference)
    base = run_evaluation(folder).report
    once, thrice = (
        run_evaluation(folder, forward="corrected", forward_options={"steps": k}).report
        for k in (1, 3)
    )
    medians = [report["err_u"]["median"] for report in (base, once, thrice)]
    assert medians[0] > 2.0 * medians[1]
    assert medians[2] < 1e-3 * medians[1]
    assert (once["forward"], once["forward_options"]) == ("corrected", {"steps": 1})
    assert (once["label"], once["reference"]) == ("emulator + 1 Newton step", "our FEM")
    assert base["forward_options"] == {}


@pytest.mark.slow
def test_files_and_figures(folder, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["--forward", "reduced", "--fem-runs", "10", "--cases", "4"]
    words += ["--against", "fem", "--out", str(out), "--json"]
    assert main(["evaluate", folder, *words]) == 0
    report = json.loads(capsys.readouterr().out)
    kept = json.loads((out / "evaluation.json").read_text())
    assert kept == {name: value for name, value in report.items() if name != "files"}
    assert (kept["forward"], kept["forward_options"]) == ("reduced", {"fem_runs": 10})
    assert kept["label"] == "POD + GP of 10 FEM runs"
    assert kept["err_u"]["median"] < 1e-3 * kept["mean_u"]["median"]
    assert {path.name for path in out.iterdir()} == {
        "evaluation.json",
        "error_densities.png",
        "error_on_surface.png",
    }
    from matplotlib.image import imread

    for path in out.glob("*.png"):
        assert len(np.unique(imread(path).reshape(-1, 4), axis=0)) > 100


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--against", "fem", "--steps", "2"], "--steps has no effect without --forward corrected"),
        (["--against", "fem", "--fem-runs", "9"], "--fem-runs has no effect without --forward red"),
        (["--against", "fem", "--forward", "corrected", "--steps", "0"], "steps is 0"),
        (["--against", "fem", "--out", "/dev/null"], "cannot write to /dev/null"),
    ],
)
def test_bad_calls(folder, capsys, words, message):
    assert main(["evaluate", folder, *words]) == 2
    assert message in capsys.readouterr().err


def test_plans_that_cannot_be_carried_out():
    with pytest.raises(InputError, match="forward map 'spline' is unknown; known: emulator, corr"):
        run_evaluation("x", forward="spline")
    with pytest.raises(InputError, match="--steps has no effect without --forward corrected"):
        run_evaluation("x", forward_options={"steps": 2})


def test_evaluating_imports_no_figures():
    code = "import calibrate.analysis.evaluation, sys; assert not {'calibrate.figures', 'matplotlib'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
