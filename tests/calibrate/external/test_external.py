"""Calibration of external problems: by a solver's runs, and by a table of them."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import calibrate as cal
import emulator as em
from calibrate.cli import main
from calibrate.external.by_rows import examine_rows
from calibrate.measurements import observations_from_json, parse_observation
from calibrate.measurements.words import kinds_of
from calibrate.project import read_posterior
from cli_support import answer, complaint
from emulator.catalogue import find_problem
from emulator.external.rows import RowsMap, process_in
from emulator.external.solver import ExternalSimulator

PROBLEM = """
loads = ["force"]
[solver]
kind = "python"
function = "bar.py:solve"
[parameters.k]
unit = "N/mm"
median = 2.0
log_sd = 1.0
[parameters.b]
median = 0.5
log_sd = 1.0
[parameters.force]
unit = "N"
range = [0.1, 20.0]
[outputs.extension]
unit = "mm"
[outputs.profile]
size = 2
"""
# force = k u exp(b u^2), and derivatives of the root u.
BAR = """
import math
def solve(k, b, force):
    if FAILS:
        raise ValueError("no convergence")
    low, high = 0.0, 100.0
    for _ in range(100):
        u = 0.5 * (low + high)
        low, high = (u, high) if math.log(k * u) + b * u * u < math.log(force) else (low, u)
    slope = 1.0 / u + 2.0 * b * u  # of the logarithm of the force
    by = {"k": -1.0 / k / slope, "b": -u * u / slope, "force": 1.0 / force / slope}
    outputs = {"extension": u, "profile": [u, u * u]}
    return outputs, {"extension": by, "profile": {n: [d, 2 * u * d] for n, d in by.items()}}
"""
TRUTH = {"k": 3.0, "b": 0.7}
FORCES = (1.0, 3.0, 6.0, 10.0)
FEW = ("--warmup", 200, "--draws", 250, "--sampler", "nuts")


def write_bar(folder, fails="False"):
    """The problem's files, and data at the truth, in ``folder``."""
    (folder / "bar.py").write_text(BAR.replace("FAILS", fails))
    (folder / "bar.toml").write_text(PROBLEM)
    scope = {}
    exec(BAR.replace("FAILS", "False"), scope)
    rng = np.random.default_rng(0)
    rows = [
        (f, scope["solve"](**TRUTH, force=f)[0]["extension"] + rng.normal(0, 0.02)) for f in FORCES
    ]
    with (folder / "data.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("force", "extension"), *rows])
    return folder / "bar.toml"


def posterior_by_grid(folder):
    """Mean and sd of k and b, by the model's own formula on a grid."""
    with (folder / "data.csv").open() as file:
        force, u = np.array(
            [(float(r["force"]), float(r["extension"])) for r in csv.DictReader(file)]
        ).T
    k, b = np.meshgrid(np.geomspace(1.5, 5.0, 160), np.geomspace(0.3, 1.4, 160), indexing="ij")
    low, high = np.zeros((*k.shape, 4)), np.full((*k.shape, 4), 10.0)
    for _ in range(60):
        x = 0.5 * (low + high)
        below = np.log(k[..., None] * x) + b[..., None] * x**2 < np.log(force)
        low, high = np.where(below, x, low), np.where(below, high, x)
    log = -0.5 * (((x - u) / 0.02) ** 2).sum(axis=-1)
    log -= 0.5 * (np.log(k / 2.0) ** 2 + np.log(b / 0.5) ** 2)  # log-normals on a grid of logs
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    moments = {}
    for name, values in (("k", k), ("b", b)):
        mean = (weights * values).sum()
        moments[name] = mean, np.sqrt((weights * (values - mean) ** 2).sum())
    return moments


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """The folder of a posterior of the bar, and the answer of infer."""
    folder = tmp_path_factory.mktemp("bar")
    words = [write_bar(folder), "--data", folder / "data.csv", "--noise", "extension=0.02"]
    words += [*FEW, "--out", folder / "run", "--json"]
    with pytest.MonkeyPatch.context() as patch:
        told = []
        patch.setattr("builtins.print", lambda *texts, **_: told.append(" ".join(map(str, texts))))
        code = main(["infer", *map(str, words)])
    return folder, code, json.loads(told[-1])


def test_a_solver_is_calibrated_and_its_posterior_is_that_of_the_formula(calibrated):
    folder, code, told = calibrated
    assert (code, told["verdict"]) == (0, "accepted")
    for name, (mean, sd) in posterior_by_grid(folder).items():
        row = told["parameters"][name]
        assert row["mean"] == pytest.approx(mean, abs=0.25 * sd)
        assert row["sd"] == pytest.approx(sd, rel=0.2)
    assert "another program's" in told["certificate"]["mesh"]["not_asked"]
    assert told["rounds"][-1]["failed"] == 0


def test_its_posterior_is_read_again_certified_and_reported(calibrated, capsys):
    folder = calibrated[0]
    _, posterior = read_posterior(folder / "run")
    predicted, valid = posterior.model.predict({**TRUTH})
    assert valid
    assert [float(v) for v in predicted.values()] == pytest.approx(
        [0.3115, 0.7057, 0.9971, 1.2054], abs=0.01
    )
    code, again = answer(capsys, "certify", folder / "run", "--engine", "processes:1")
    assert (code, again["verdict"]) == (0, "accepted")
    assert main(["report", str(folder / "run")]) == 0
    assert "extension" in (folder / "run" / "report.html").read_text()


def test_a_wrong_map_of_a_solver_is_refused(calibrated):
    _, posterior = read_posterior(calibrated[0] / "run")
    model = posterior.model
    data = replace(model.full.data, constant=model.full.data.constant + 0.05)
    wrong = replace(model.full, data=data)
    forward = wrong.at(model.observe.nodes)
    lied = cal.sample(
        replace(model, full=wrong, forward=forward), posterior.data, sampler="nuts",
        options=cal.samplers.NUTSOptions(warmup=200, draws=250),
    )  # fmt: skip
    solver = ExternalSimulator(model.forward.scene)
    assert cal.certify(posterior, solver, mesh=0).verdict == "accepted"
    assert cal.certify(lied, solver, mesh=0).verdict in ("not certified", "reweight")


def test_observations_of_outputs_are_named_as_in_the_file(tmp_path):
    scene = find_problem(str(write_bar(tmp_path)))
    observe = parse_observation(scene, "extension+profile", states=("a", "b"))
    assert list(observe.parts) == ["extension@a", "extension@b", "profile@a", "profile@b"]
    assert observe.parts["profile@a"].shape == (2,)
    assert observations_from_json(scene, observe.to_json()).shapes == observe.shapes
    assert list(kinds_of(scene)) == ["extension", "profile"]
    with pytest.raises(em.InputError, match="of 'bar' there are extension, profile"):
        parse_observation(scene, "nodes:3")


def test_numbers_of_an_output_have_a_column_each_and_may_be_missing(tmp_path, capsys):
    path = write_bar(tmp_path)
    (tmp_path / "data.csv").write_text("force,profile.1,profile.2\n1.0,0.3,0.09\n3.0,0.74,NA\n")
    words = ["infer", path, "--data", tmp_path / "data.csv", "--no-certify", *FEW]
    code, told = answer(capsys, *words, "--noise", "profile=0.02", "--out", tmp_path / "run")
    assert code == 0
    assert told["parameters"]["k"]["sd"] > 0.0
    observe = read_posterior(tmp_path / "run")[1].model.observe
    assert observe.shapes == {"profile@1": (2,), "profile@2": (1,)}


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--noise", "extension=0.02", "--observe", "volume"), "--observe has no effect"),
        ((), "extension has no usual noise; give --noise extension=SD, in mm"),
        (("--noise", "extensoin=0.02"), "'extensoin' is not observed"),
        (("--noise", "extension=0.02", "--known", "nu=1"), "no parameter 'nu'"),
        (("--noise", "extension=0.02", "--engine", "slurm"), "give threads, processes:N"),
    ],
)
def test_mistakes_of_words_are_named(tmp_path, capsys, words, what):
    path = write_bar(tmp_path)
    line = complaint(
        capsys, "infer", path, "--data", tmp_path / "data.csv", *words, "--out", tmp_path / "r"
    )
    assert what in line


def test_a_solver_that_fails_at_most_of_the_prior_is_said_so(tmp_path, capsys):
    path = write_bar(tmp_path, "k > 1.0")
    words = ["infer", path, "--data", tmp_path / "data.csv", "--noise", "extension=0.02"]
    code = main([*map(str, words), "--out", str(tmp_path / "r")])
    told = capsys.readouterr().err
    assert code != 0
    assert "points of the prior" in told
    assert "no convergence" in told


def test_what_needs_a_law_or_a_mesh_says_so(calibrated, capsys):
    folder = calibrated[0]
    assert main(["identify", "after", str(folder / "run")]) == 0
    assert "stress along" not in capsys.readouterr().out
    predict = ("predict", folder / "run", "--scene", folder / "bar.toml", "--observe", "extension")
    assert "this needs a law" in complaint(capsys, *predict, "--out", folder / "p")
    effects = ("effects", folder / "bar.toml", "--observe", "extension", "--tolerance", "0.1")
    assert "another program's, which has no mesh" in complaint(capsys, *effects)


def simulated(folder, capsys, *theta):
    """The answer of ``simulate``."""
    return answer(capsys, "simulate", folder / "bar.toml", "--theta", *theta)


def test_simulate_asks_the_solver_once(tmp_path, capsys):
    write_bar(tmp_path)
    code, told = simulated(tmp_path, capsys, "k=3", "b=0.7", "force=3")
    assert code == 0
    assert told["outputs"]["extension"] == pytest.approx(told["outputs"]["profile"][0])


def write_table(folder, count=80):
    """A table of runs of two outputs, of which the data are one row."""
    x = np.random.default_rng(1).random((count, 3)) * [4.0, 1.0, 1.0] + [1.0, 0.0, 0.0]
    rows = np.column_stack([x, np.log(x[:, 0]) + 0.3 * x[:, 1], x[:, 0] * (1.0 + x[:, 1] ** 2)])
    with (folder / "runs.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["stiffness [kPa]", "share", "idle", "force [N]", "volume"])
        writer.writerows([*rows, [2.0, 0.5, 0.5, "", ""]])
    (folder / "data.csv").write_text("force,volume\n0.85,2.5\n")  # near stiffness 2, share 0.5
    return folder / "runs.csv"


def test_a_table_of_runs_is_a_posterior_with_a_verdict_and_the_next_runs(tmp_path, capsys):
    code, drafted = answer(capsys, "init", write_table(tmp_path), "--inputs", 3)
    assert code == 0
    assert drafted["parameters"] == ["stiffness", "share", "idle"]
    assert drafted["outputs"] == ["force", "volume"]
    words = ["infer", tmp_path / "runs.toml", "--data", tmp_path / "data.csv", *FEW]
    words += ["--noise", "force=0.05", "volume=0.2", "--bounded", "share", "idle", "stiffness"]
    code, told = answer(capsys, *words, "--out", tmp_path / "run")
    assert (code, told["verdict"]) == (0, "accepted")
    rows = told["parameters"]
    assert rows["stiffness"]["mean"] == pytest.approx(2.0, abs=3 * rows["stiffness"]["sd"])
    assert rows["idle"]["sd"] == pytest.approx(1.0 / np.sqrt(12.0), rel=0.1)
    assert told["certificate"]["draws"] == 0
    assert any("no run was made" in finding for finding in told["certificate"]["findings"])
    with (tmp_path / "run" / "next_runs.csv").open() as file:
        following = list(csv.DictReader(file))
    assert len(following) == 8
    assert all(1.0 <= float(row["stiffness"]) <= 5.0 for row in following)
    assert set(systematic_of(tmp_path / "run")) == {"emulator"}
    assert main(["report", str(tmp_path / "run")]) == 0
    capsys.readouterr()
    line = complaint(capsys, "init", tmp_path / "runs.csv", "--inputs", 3)
    assert line.endswith("give another name with --out")


def write_line(folder, capsys):
    """A posterior of the slope of y = 2 a, by a table: a is 0.5 +- 0.05."""
    rows = [(a, 2.0 * a) for a in np.linspace(0.0, 1.0, 21).tolist()]
    with (folder / "runs.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("a", "y"), *rows])
    (folder / "data.csv").write_text("y\n1.0\n")
    main(["init", str(folder / "runs.csv"), "--inputs", "a"])
    words = ["infer", folder / "runs.toml", "--data", folder / "data.csv", "--noise", "y=0.1"]
    main([*map(str, words), *map(str, FEW), "--bounded", "a", "--out", str(folder / "run")])
    capsys.readouterr()
    return read_posterior(folder / "run")


def test_moves_are_those_of_data_that_the_emulator_misses_by_as_much(tmp_path, capsys, monkeypatch):
    _, posterior = write_line(tmp_path, capsys)
    sd = posterior.draws()["a"].std()
    assert sd == pytest.approx(0.05, rel=0.1)

    def constant(self, theta, outputs, count, rng):
        shape = (count, len(theta), len(outputs))
        return np.full(shape, 0.04), np.full(shape[1:], 0.04)

    monkeypatch.setattr(RowsMap, "drawn_errors", constant)
    certificate = examine_rows(posterior)
    # y is 0.04 above the map: a moves by -0.02, which is -0.4 sd.
    assert certificate.evidence.draws.shift["a"].value == pytest.approx(0.02 / sd, rel=0.15)
    assert certificate.verdict == "not certified"


def systematic_of(folder):
    """The systematic errors of a run."""
    return json.loads((folder / "run.json").read_text())["systematic"]


def test_data_have_noise_and_the_covariance_of_errors_at_rows_left_out(tmp_path, capsys):
    main(["init", str(write_table(tmp_path)), "--inputs", "3"])
    capsys.readouterr()
    words = ["infer", tmp_path / "runs.toml", "--data", tmp_path / "data.csv", "--no-certify"]
    words += ["--noise", "force=0.001", "volume=0.002", "--sampler", "laplace"]
    main([*map(str, words), "--out", str(tmp_path / "run")])
    _, posterior = read_posterior(tmp_path / "run")
    errors = process_in(find_problem(str(tmp_path / "runs.toml"))).left_out
    sizes = np.quantile(np.abs(errors), 0.9, axis=0) / 1.6449
    shared = np.sum(errors[:, 0] * errors[:, 1]) / np.prod(np.linalg.norm(errors, axis=0))
    covariance = np.diag([0.001**2, 0.002**2]) + np.outer(sizes, sizes) * [[1, shared], [shared, 1]]
    model, draws = posterior.model, posterior.draws()
    for k in (0, 100):
        draw = {name: values[k] for name, values in draws.items()}
        means, _ = model.predict(draw)
        expected = multivariate_normal([means["force"], means["volume"]], covariance)
        told = model.map_log_likelihood(draw, posterior.data)
        assert float(told) == pytest.approx(expected.logpdf([0.85, 2.5]), abs=1e-6)


def test_a_known_noise_is_widened_beside_one_that_is_inferred(tmp_path, capsys):
    main(["init", str(write_table(tmp_path)), "--inputs", "3"])
    capsys.readouterr()
    words = ["infer", tmp_path / "runs.toml", "--data", tmp_path / "data.csv", "--no-certify"]
    words += ["--noise", "force=0.001", "volume=gaussian:sd_scale=0.2", *FEW]
    main([*map(str, words), "--out", str(tmp_path / "run")])
    noise = json.loads((tmp_path / "run" / "run.json").read_text())["noise"]
    errors = np.abs(process_in(find_problem(str(tmp_path / "runs.toml"))).left_out[:, 0])
    size = np.quantile(errors, 0.9) / 1.6449
    assert noise["force"] ** 2 == pytest.approx(0.001**2 + size**2, rel=1e-6)
    assert not systematic_of(tmp_path / "run")


def test_a_table_too_coarse_for_its_data_teaches_next_to_nothing(tmp_path, capsys):
    rng = np.random.default_rng(2)
    x = rng.random((14, 2))
    rows = np.column_stack([x, np.sin(14.0 * x[:, 0]) + np.cos(11.0 * x[:, 1])])
    with (tmp_path / "runs.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["a", "b", "y"], *rows])
    (tmp_path / "data.csv").write_text("y\n0.5\n")
    main(["init", str(tmp_path / "runs.csv"), "--inputs", "a", "b"])
    capsys.readouterr()
    words = ["infer", tmp_path / "runs.toml", "--data", tmp_path / "data.csv", "--noise", "y=0.01"]
    code, told = answer(capsys, *words, *FEW, "--bounded", "a", "b", "--out", tmp_path / "run")
    (modes,) = systematic_of(tmp_path / "run")["emulator"]["modes"]
    assert np.linalg.norm(modes) > 0.3  # the emulator knows next to nothing, and says so
    assert code == 0
    assert all(row["sd"] > 0.75 / np.sqrt(12.0) for row in told["parameters"].values())
    assert (tmp_path / "run" / "next_runs.csv").is_file()


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--inputs", "7"), "--inputs 7: "),
        (("--inputs", "stiff"), "has no column 'stiff'"),
        (("--inputs", "3", "--law", "neo_hookean"), "--law has no effect beside --inputs"),
    ],
)
def test_inputs_that_are_not_there_are_refused(tmp_path, capsys, words, what):
    assert what in complaint(capsys, "init", write_table(tmp_path), *words)
