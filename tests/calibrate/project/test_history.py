"""A body in time by commands: from a scene file with a history to a certificate and a page."""

import csv
import json

import numpy as np
import pytest

from calibrate.cli import main
from calibrate.measurements import leave_out_missing
from calibrate.project import Run, read_posterior, read_problem
from cli_support import answer, complaint
from history_support import BY_GRIP, CUBE, write_cube

SCENE = (
    CUBE
    + BY_GRIP.replace("0.2", "0.1")
    + """
[constants]
kappa = 100.0
tau_1 = 2.0
[parameters]
mu = {unit = "kPa", median = 8.0, log_sd = 0.4}
relaxation_1 = {range = [0.05, 0.95]}
"""
)
TRUTH = {"mu": 9.0, "relaxation_1": 0.6}
FORCE = "reaction:end:x"
NOISE = 2e-5  # N
# The stretch is even and its steps are short, so that a finer mesh and shorter steps change little.
ROWS = [("up", 0.2 * k, 0.2 * k) for k in range(1, 6)] + [("up", 2.0, 1.0), ("up", 6.0, 1.0)]
BOUNDED = ("--bounded", "relaxation_1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A cube's scene file and history, and a posterior from synthetic forces."""
    folder = tmp_path_factory.mktemp("history")
    rows = "\n".join(f"{name},{time},{pull}" for name, time, pull in ROWS)
    write_cube(folder, SCENE, f"protocol,time [s],pull\n{rows}\n")
    words = ["--truth", *(f"{n}={v}" for n, v in TRUTH.items()), "--observe", FORCE]
    words += ["--noise", f"{FORCE}={NOISE}", *BOUNDED, "--draws", "200", "--seed", "1"]
    code = main(["infer", str(folder / "cube.toml"), *words, "--out", str(folder / "run")])
    assert code == 0  # accepted
    return folder


def test_the_truth_is_found_and_the_verdict_is_of_mesh_and_steps(folder):
    _, posterior = read_posterior(folder / "run")
    for name, row in posterior.summary().items():
        assert abs(row["mean"] - TRUTH[name]) < 3.5 * row["sd"]
    certificate = json.loads((folder / "run" / "certificate.json").read_text())
    assert certificate["verdict"] == "accepted"
    assert certificate["mesh"]["of"] == "mesh and steps"
    assert certificate["mesh"]["nodes"] == 27
    assert 0.0 < max(map(abs, certificate["mesh"]["shift"].values())) < 0.5


def test_measured_data_may_have_gaps_and_units(folder):
    cells = [0.5 if k != 2 else "" for k in range(len(ROWS))]  # mN
    rows = [[*row, cell] for row, cell in zip(ROWS, cells, strict=True)]
    with (folder / "data.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("protocol", "time [ms]", "pull", f"{FORCE} [mN]"), *rows])
    text = (folder / "data.csv").read_text()
    for _, time, _ in ROWS:
        text = text.replace(f",{time},", f",{1000 * time:g},")
    (folder / "data.csv").write_text(text)
    run = Run(str(folder / "cube.toml"), data=str(folder / "data.csv"), noise={FORCE: NOISE})
    problem = read_problem(run)
    (force,) = problem.data.values()
    np.testing.assert_allclose(force, [5e-4, 5e-4, np.nan, 5e-4, 5e-4, 5e-4, 5e-4])
    measured, present = leave_out_missing(problem.observe, problem.data)
    assert measured.shapes == {FORCE: (6,)}
    curve = measured.parts[FORCE].curves(measured.entries[FORCE])
    np.testing.assert_allclose(curve["up"][0], [0.2, 0.4, 0.8, 1.0, 2.0, 6.0])
    np.testing.assert_array_equal(curve["up"][1], np.arange(len(present[FORCE])))


def test_the_page_has_the_history_over_time(folder):
    assert main(["report", str(folder / "run")]) == 0
    assert "time (s)" in (folder / "run" / "report.html").read_text()


def test_simulate_tells_each_row_and_the_error_of_its_steps(folder, capsys):
    theta = ["--theta", "mu=9", "relaxation_1=0.6"]
    code, told = answer(capsys, "simulate", folder / "cube.toml", *theta, "--out", folder / "a.vtu")
    assert code == 0
    np.testing.assert_allclose(told["rows"]["time"], [row[1] for row in ROWS])
    assert told["rows"]["largest displacement (mm)"][-1] > 0.1
    assert 0.0 < told["half_steps_mm"] < 1e-3
    assert len(list(folder.glob("a_*.vtu"))) == len(ROWS)


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["infer", "--observe", FORCE, "--out", "x"], f"{FORCE} has no usual noise"),
        (["infer", "--observe", "landmarks:5", "--out", "x"], "there are volume, length, reaction"),
        (["infer", "--observe", "reaction:roof:x", "--out", "x"], "has no support on 'roof'"),
        (["infer", "--observe", "volume", "--out", "x"], "has 0 cavities"),
        (
            ["infer", "--observe", FORCE, "--noise", f"{FORCE}=1", "--load-steps", "4", "--out", "x"],
            "'cube' has steps of its own; omit --load-steps 4",
        ),
        (["train", "--out", "x"], "goes through a history"),
        (["campaign", "--samples", "2", "--out", "x.zarr"], "goes through a history"),
        (["unload", "--theta", "mu=8", "relaxation_1=0.5"], "goes through a history"),
        (["export", "--to", "febio", "--out", "x"], "cube.toml"),
        (["simulate", "--theta", "mu=8", "relaxation_1=0.5", "time=3"], "time"),
    ],
)  # fmt: skip
def test_what_a_history_does_not_take_is_refused_in_one_line(folder, capsys, words, fault):
    command, *rest = words
    if command == "infer":
        rest += ["--truth", "mu=8", "relaxation_1=0.5"]
    rest = [str(folder / word) if word in ("x", "x.zarr") else word for word in rest]
    assert fault in complaint(capsys, command, folder / "cube.toml", *rest)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda rows: rows[:-1], "6 rows; the history of scene 'cube' has 7"),
        (lambda rows: [*rows[:-1], ["up", 7.0, 1.0, 0.5]], "row 7: time is 7 s, and 6 in the"),
        (lambda rows: [[*row[:3], ""] for row in rows], "every value of reaction:end:x is missing"),
        (lambda rows: [[*row[:3], "?"] for row in rows], "'?', not a number"),
    ],
)
def test_data_that_are_not_the_historys_are_refused(folder, capsys, change, fault):
    rows = change([[*row, 0.5] for row in ROWS])
    with (folder / "bad.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("protocol", "time", "pull", f"{FORCE} [mN]"), *rows])
    words = ["--data", folder / "bad.csv", "--noise", f"{FORCE}={NOISE}", "--out", folder / "y"]
    assert fault in complaint(capsys, "infer", folder / "cube.toml", *words)


def test_a_run_whose_history_changed_is_refused(folder, tmp_path, capsys):
    for file in ("cube.toml", "cube.vtu"):
        (tmp_path / file).write_bytes((folder / file).read_bytes())
    later = (folder / "history.csv").read_text().replace("6.0,", "7.0,")
    (tmp_path / "history.csv").write_text(later)
    run = json.loads((folder / "run" / "run.json").read_text())
    (tmp_path / "run").mkdir()
    for file in (folder / "run").iterdir():
        if file.is_file() and not file.name.startswith("."):
            (tmp_path / "run" / file.name).write_bytes(file.read_bytes())
    run["scene"] = str(tmp_path / "cube.toml")
    (tmp_path / "run" / "run.json").write_text(json.dumps(run))
    assert "made for another scene" in complaint(capsys, "certify", tmp_path / "run")
