"""The ventricle's demo on a coarse mesh with a reduced model: the same path, short chains."""

import json
from dataclasses import replace
from functools import cache, partial

import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from calibrate.cli import main
from calibrate.measurements.data import read_measurements
from calibrate.posterior import read_tree
from calibrate.project import demo as demos
from calibrate.project import read_posterior, simulator_of
from emulator.geometry.facets import Cavity
from emulator.scenes.built_in import BUILT_IN

# One scene for the whole module, so that its simulator is compiled once.
COARSE = cache(partial(em.scenes.left_ventricle, rings=4, around=8, layers=1, order=1))
RUN = replace(
    demos.VENTRICLE,
    forward="reduced",
    forward_options={"fem_runs": 25},
    warmup=100,
    draws=250,
    chains=2,
)


@pytest.fixture(scope="module")
def setting():
    """The coarse scene under the ventricle's name, and its short run as the demo."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BUILT_IN, "left_ventricle", COARSE)
        patch.setitem(demos.DEMOS, "left_ventricle", RUN)
        yield


@pytest.fixture(scope="module")
def folder(setting, tmp_path_factory):
    return tmp_path_factory.mktemp("ventricle")


@pytest.mark.slow
def test_the_demo_finds_the_truth_and_says_what_it_does_not_know(folder, capsys):
    code = main(["demo", "--scene", "left_ventricle", "--out", str(folder), "--json"])
    report = json.loads(capsys.readouterr().out)
    assert code == (0 if report["verdict"] == "accepted" else 1)
    assert report["certificate"]["failed"] == 0
    assert list(report["parameters"]) == ["a", "b", "a_f", "b_f", "pressure"]
    for name, row in report["parameters"].items():
        assert row["truth"] == RUN.truth[name]
        assert abs(row["mean"] - row["truth"]) < 4 * row["sd"]
    found = report["identifiability"]
    # Stiffness and load move together: a product of powers is known better than any of its factors.
    best = found["combinations"][0]
    assert best["known_to"] < 0.95 * min(
        report["parameters"][n]["sd"] / report["parameters"][n]["mean"] for n in best["exponents"]
    )
    tree = read_tree(folder / "posterior.nc")
    a_f, pressure = (np.asarray(tree["posterior"][n]).ravel() for n in ("a_f", "pressure"))
    expected = np.corrcoef(np.log(a_f), pressure)[0, 1]
    assert found["correlation"]["a_f"]["pressure"] == pytest.approx(expected)
    # Uniform over the box: sd = width / sqrt(12).
    box = COARSE().parameters[-1]
    shrunk = 1.0 - report["parameters"]["pressure"]["sd"] / ((box.high - box.low) / np.sqrt(12.0))
    assert found["contraction"]["pressure"] == pytest.approx(shrunk, abs=0.02)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "The body" in page
    assert f"{RUN.truth['a_f']:.4g}" in page


@pytest.mark.slow
def test_its_files_hold_both_observations(folder):
    scene = COARSE()
    tree = read_tree(folder / "posterior.nc")
    assert tree["observed_data"]["displacement"].shape == (24, 3)
    assert tree["observed_data"]["volume"].shape == (1,)  # ArviZ wants a dimension
    assert tree["constant_data"]["position"].shape == (24, 3)
    assert json.loads(tree.attrs["noise"])["volume"] == {
        "kind": "gaussian",
        "sd": 1.0,
        "sd_scale": None,
    }
    observe, data = read_measurements(scene, folder / "data.csv")[:2]
    assert list(observe.parts) == ["displacement", "volume"]
    np.testing.assert_array_equal(data["volume"], tree["observed_data"]["volume"])
    # The data is FEM at the truth, within the noise.
    u = simulator_of(scene)(scene.theta(**RUN.truth))
    cavity = Cavity(scene.mesh, "endocardium")
    V = float(cavity(u[cavity.nodes]))
    assert data["volume"] == pytest.approx(V, abs=4.0)
    gap = data["displacement"] - observe.parts["displacement"](
        jnp.asarray(u[observe.parts["displacement"].nodes]), scene.theta(**RUN.truth)
    )
    assert np.std(gap) == pytest.approx(RUN.noise["displacement"], rel=4 / np.sqrt(2 * gap.size))


@pytest.mark.slow
def test_its_folder_is_read_back(folder):
    run, posterior = read_posterior(folder)
    assert run == RUN
    assert float(posterior.data["volume"]) == float(
        read_measurements(COARSE(), folder / "data.csv")[1]["volume"]
    )


@pytest.mark.slow
def test_infer_takes_both_and_infers_a_noise(setting, folder, tmp_path, capsys):
    words = ["infer", "left_ventricle", "--data", str(folder / "data.csv"), "--forward", "reduced"]
    words += ["--fem-runs", "6", "--warmup", "20", "--draws", "20", "--chains", "2", "--no-certify"]
    words += ["--noise", "0.2", "--noise-scale", "volume=2.0"]
    words += ["--out", str(tmp_path / "r"), "--json"]
    assert main(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert list(report["parameters"])[-1] == "noise_sd_volume"
    kept = json.loads((tmp_path / "r" / "run.json").read_text())
    assert (kept["noise"]["displacement"], kept["noise_scale"]) == (0.2, {"volume": 2.0})
    noise = json.loads(read_tree(tmp_path / "r" / "posterior.nc").attrs["noise"])
    assert noise["displacement"] == {"kind": "gaussian", "sd": 0.2, "sd_scale": None}
    assert noise["volume"] == {"kind": "gaussian", "sd": None, "sd_scale": 2.0}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--noise", "volume=0"],
            "volume (mL): noise 'gaussian': standard deviation is 0.0; it must be above",
        ),
        (["--noise", "pressure=1"], "noise: 'pressure' is not observed; observed: displacement"),
        (["--observe", "landmarks:3+volume+volume"], "volume is given twice"),
        (["--observe", "volume:atrium"], "facet set 'atrium' is not in the mesh"),
    ],
)
def test_bad_words_about_volumes(setting, tmp_path, capsys, options, message):
    words = ["infer", "left_ventricle"]
    words += [] if "--observe" in options else ["--observe", "landmarks:3+volume"]
    words += ["--truth", *(f"{name}={value}" for name, value in RUN.truth.items())]
    assert main([*words, *options, "--out", str(tmp_path / "r")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "r").exists()
