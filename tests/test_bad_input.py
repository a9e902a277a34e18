"""Bad input, by command line and by Python: one line that names thing and remedy, and no files."""

import json
import shlex
import shutil
from dataclasses import asdict

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import calibrate as cal
import emulator as em
from bad_words import COMMANDS, INFERENCES
from calibrate.analysis.sbc import sbc
from calibrate.cli import COMMANDS as COMMAND_NAMES
from calibrate.cli import main
from calibrate.cli.words import seconds
from calibrate.measurements.data import read_measurements, write_data
from calibrate.project import Run
from cli_support import write_block
from data_support import make_data
from emulator.core.errors import InputError
from emulator.surrogates.folders import SHIPPED
from emulator.training import recipe
from emulator.training.job import Job
from emulator.training.paper import Paper
from linear_support import linear_forward

BEAM = em.scenes.once_clamped_beam(cells=(4, 2, 2), order=1)
OBSERVE = cal.nodal_displacements(BEAM, [3, 11, 20, 30])
FREE_END = em.scenes.once_clamped_beam().mesh.node_set("right").tolist()
NODES = "node,ux,uy,uz\n"
PLACES = "x,y,z,ux,uy,uz\n"


def model(noise=0.2):
    return cal.model(linear_forward(BEAM, size=0.05), OBSERVE, cal.GaussianNoise(sd=noise))


PYTHON = [
    (lambda: BEAM.theta(mu=500.0, lam=60.0), "parameter 'mu' is 500 kPa"),
    (lambda: BEAM.theta(mu=60.0), "no value for parameter 'lam'"),
    (lambda: BEAM.theta(mu=60.0, lam=60.0, nu=0.3), "has no parameter 'nu'"),
    (lambda: em.find_scene("beam"), "scene 'beam' is unknown; built in:"),
    (lambda: em.find_scene("published:Liver"), "say where the published data is with --root DIR"),
    (lambda: em.load("nowhere"), "emulator 'nowhere' is neither shipped nor a folder"),
    (lambda: em.load("broken"), "is truncated or not a safetensors"),
    (lambda: em.read_mesh("none.msh"), "mesh file none.msh does not exist"),
    (lambda: em.Simulator(BEAM).solve(jnp.zeros(3)), "theta has shape (3,); expected (2,)"),
    (
        lambda: em.Simulator(BEAM).reaction("apex", jnp.zeros((45, 3)), BEAM.centre),
        "node set 'apex' is not in the mesh; its sets:",
    ),
    (lambda: em.fem.NewtonOptions.load_steps(0), "0 load steps; give 1 or more"),
    (lambda: cal.nodal_displacements(BEAM, [4000]), "node 4000 is unknown"),
    (
        lambda: cal.nodal_displacements(BEAM, [3, 3]),
        "node 3 is observed twice; give each node once",
    ),
    (lambda: cal.nodal_displacements(BEAM, "apex"), "'apex'"),
    (lambda: cal.landmarks(BEAM, [[1e3, 0, 0]]), "lies outside the body"),
    (
        lambda: cal.landmarks(BEAM, [[9.0, 5, 5]] * 2),
        "landmarks 0 and 1 are both at [9.0, 5.0, 5.0]",
    ),
    (lambda: cal.landmarks(BEAM, [[9.0, 5]]), "shape (1, 2); expected (d, 3), finite, in mm"),
    (lambda: cal.strains(BEAM, "fibre", [[9.0, 5, 5]]), "fibre"),
    (lambda: cal.surface_points(BEAM, "luck", [[9.0, 5, 5]]), "'luck'"),
    (lambda: cal.CavityVolume(BEAM), "has 0 cavities"),
    (lambda: cal.length_between(BEAM, "0", "0"), "both landmarks are at"),
    (lambda: cal.GaussianNoise(sd=-1.0), "standard deviation is -1.0"),
    (lambda: cal.StudentTNoise(dof=4.0), "give either scale (known) or prior_scale"),
    (lambda: model(noise=0.0), "standard deviation is 0.0"),
    (lambda: model().check_data(np.full((4, 3), 5e-3)), "m instead of mm? multiply by 1000"),
    (lambda: model().check_data(np.full((4, 3), 0.5)), "cm instead of mm? multiply by 10 "),
    (lambda: model().check_data(np.full((3, 3), 5.0)), "data has shape (3, 3)"),
    (
        lambda: cal.sample(model(), np.full((4, 3), np.nan)),
        "every value of displacement is missing",
    ),
    (lambda: cal.sample(model(), np.ones((4, 3)), sampler="luck"), "sampler 'luck' is unknown"),
    (lambda: cal.samplers.NUTSOptions(draws=0), "draws is 0; it must be 1 or more"),
    (lambda: cal.campaign(BEAM), "give a number of samples or thetas, one of them"),
    (lambda: cal.campaign(BEAM, 2, design="luck"), "design 'luck' is unknown"),
    (lambda: cal.sensitivity(linear_forward(BEAM)), "give something to observe"),
    (
        lambda: cal.sensitivity(linear_forward(BEAM), OBSERVE, samples=3),
        "3 samples; give 2 or more",
    ),
    (lambda: sbc(model(), 3), "3 replicates; give 20 or more"),
    (lambda: cal.compare({}), "compare: 0 posterior is given; give two or more"),
    (lambda: cal.priors.truncated_normal(1.0, -1.0, low=0.0, high=2.0), "-1"),
    (lambda: read_measurements(BEAM, "none.csv"), "none.csv does not exist"),
    (lambda: read_measurements(BEAM, "twice.csv"), "landmarks 0 and 2 are both at"),
    (lambda: Run("liver", data="blanks.csv", truth={"mu": 5.0}), "truth has no effect beside data"),
    (lambda: Run("liver", draws=0), "draws is 0; it must be 1 or more"),
    (lambda: Run("liver", forward_options={"fem_runs": 9}), "no effect without --forward reduced"),
    (lambda: recipe("luck"), "recipe 'luck' is unknown; known: mechanics"),
    (lambda: Paper(steps=0), "steps is 0; it must be 1 or more"),
    (
        lambda: Job(BEAM, budget=1.0),
        "a budget of 1 s: one FEM solution and its compilation alone take",
    ),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the bad words name: data files, a scene, emulators, kept posteriors."""
    folder = tmp_path_factory.mktemp("bad")
    write_block(folder)
    (folder / "cut.msh").write_text("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n9\n1 0")
    rows = [f"{node},0,0,-15" for node in FREE_END]
    tables = {
        "inf": f"{NODES}30,0,0,0\n31,0,inf,0",
        "gone": f"{NODES}30,NA,,nan",
        "node": f"{NODES}4000,0,0,0",
        "commas": f"{NODES}30,0,5,0,1,-15,2",
        "thousands": "node;ux;uy;uz\n30;1.234,5;0;0",
        "tabs": "\n".join([NODES.strip(), *rows]).replace(",", "\t"),
        "blanks": "\n".join([NODES.strip(), *rows]).replace(",", ", "),
        "comment": "# node,ux,uy,uz\n# 30,0,0,0",
        "headless": "30,0,0,-15",
        "empty_cell": f"{NODES},0,0,-15",
        "twice": f"{PLACES}90,5,5,0,0,-15\n80,5,5,0,0,-12\n90,5,5,0,0,-15",
        "node_twice": "\n".join([NODES.strip(), *rows, rows[0]]),
        "outside": f"{PLACES}900,5,5,0,0,-15",
        "mm3": "volume\n146500",
        "negative": "volume\n-120",
        "small": "volume\n120",
    }
    # The free end moves by 50 to 77 mm.
    for name, sag in (
        ("metres", 0.06),
        ("centimetres", 6.0),
        ("pixels", 720.0),
        ("upside_down", -60.0),
        ("zero", 0.0),
        ("huge", 1e9),
    ):
        tables[name] = "\n".join([NODES.strip(), *(f"{node},0,0,{-sag}" for node in FREE_END)])
    tables["swapped"] = "\n".join([NODES.strip(), *(f"{node},0,-60,0" for node in FREE_END)])
    for name, text in tables.items():
        (folder / f"{name}.csv").write_text(text + "\n")
    (folder / "book.xlsx").write_bytes(b"PK")
    emulators(folder)
    posteriors(folder)
    return folder


def emulators(folder):
    """One with weights cut short, one of another scene."""
    for name in ("broken", "other"):
        shutil.copytree(SHIPPED / "once_clamped_beam", folder / name)
    weights = folder / "broken" / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:5000])
    text = json.loads((folder / "other" / "emulator.json").read_text())
    (folder / "other" / "emulator.json").write_text(json.dumps({**text, "fingerprint": "0" * 16}))


def posteriors(folder):
    """Kept ones whose run.json was edited; tests/calibrate/project/test_results.py has sampled ones."""
    scene = em.scenes.once_clamped_beam()
    truth = {"mu": 73.0, "lam": 61.0}
    run = asdict(Run(scene.name, truth=truth, noise={"displacement": 0.2}))
    about = {"scene_fingerprint": scene.fingerprint, "run": json.dumps(run)}
    for name, now in {
        "kept": run,
        "edited": {**run, "noise": {"displacement": 2.0}},
        "lacking": {key: value for key, value in run.items() if key != "seed"},
        "noiseless": {key: value for key, value in run.items() if key != "noise"},
        "unknown": {**run, "nois": 0.2},
    }.items():
        (folder / name).mkdir()
        (folder / name / "run.json").write_text(json.dumps(now))
        tree = xr.DataTree(xr.Dataset(attrs=about))
        tree.to_netcdf(folder / name / "posterior.nc", engine="h5netcdf")


def listing(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


CALLS = [*COMMANDS, *((f"infer once_clamped_beam {w} --out result", m) for w, m in INFERENCES)]


@pytest.mark.parametrize(("bad", "message"), [*CALLS, *PYTHON])
def test_bad_input(capsys, monkeypatch, folder, bad, message):
    """The words of a command, or a function."""
    monkeypatch.chdir(folder)
    before = listing(folder)
    if callable(bad):
        with pytest.raises(InputError) as caught:
            bad()
        said = str(caught.value)
    else:
        assert main(shlex.split(bad)) == 2
        out, said = capsys.readouterr()
        assert out == ""
        assert said.startswith("calibrate: ")
    assert message in said
    assert len(said.strip().splitlines()) == 1
    assert listing(folder) == before


def test_all_commands_are_among_them():
    assert len(CALLS) + len(PYTHON) >= 150
    assert set(COMMAND_NAMES) - {"demo"} <= {words.split()[0] for words, _ in CALLS}


def test_unusual_input_is_taken(folder, monkeypatch, tmp_path):
    """What a newcomer may do without harm; CSV's dialects: tests/calibrate/measurements/test_data.py."""
    monkeypatch.chdir(folder)
    scene = em.scenes.once_clamped_beam()
    for name in ("tabs", "blanks"):
        observe, data = read_measurements(scene, f"{name}.csv")[:2]
        np.testing.assert_array_equal(observe.parts["displacement"].nodes, FREE_END)
        np.testing.assert_array_equal(data["displacement"][:, 2], -15.0)
    assert seconds("1h30m") == 5400.0
    out = tmp_path / "made" / "by the way" / "u.vtu"
    assert main(["simulate", "scene.toml", "--out", str(out), "--json"]) == 0
    assert out.is_file()


@pytest.mark.slow
def test_landmarks_a_millimetre_off(tmp_path, capsys):
    """Data that no theta explains with the noise given: exit code 1, and the hint says so."""
    run = Run("once_clamped_beam", truth={"mu": 73.0, "lam": 61.0}, observe="landmarks:12")
    observe, data = make_data(run, em.scenes.once_clamped_beam())
    data["displacement"] += np.random.default_rng(1).normal(0.0, 1.0, (12, 3))
    write_data(tmp_path / "off.csv", observe, data)
    words = ["infer", "once_clamped_beam", "--data", str(tmp_path / "off.csv"), "--noise", "0.2"]
    words += ["--warmup", "200", "--draws", "300", "--chains", "2"]
    assert main([*words, "--json", "--out", str(tmp_path / "r")]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["certificate"]["verdict"] != "accepted"
    assert any("does not fit" in hint for hint in found["warnings"])
