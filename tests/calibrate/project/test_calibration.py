"""One calibration reads its data once, builds its scene once and compiles FEM once."""

from collections import Counter

import pytest

import calibrate as cal
import emulator as em
import journeys
from calibrate.cli import main
from calibrate.measurements import data as reader
from calibrate.project import Problem, Run, by_fem, infer, read_problem, simulator_of
from calibrate.project.problem import with_data
from calibrate.report import page
from emulator.fem import NewtonOptions
from emulator.scenes.built_in import BUILT_IN
from linear_support import linear_forward

BEAM = "once_clamped_beam"
NODES = "node,ux,uy,uz\n3,0.5,0.0,-9.0\n7,0.4,0.1,-5.0\n11,0.2,0.0,-2.0\n19,0.1,0.0,-7.0\n"


class Stopped(Exception):
    """Stands for the rest of a program."""


@pytest.fixture
def count(monkeypatch):
    """Count the scenes that are built and the data files that are opened; the beam is coarse."""
    counts = Counter()
    read_csv = reader.read_csv

    def build(**_):
        counts["scene"] += 1
        return em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)

    def opened(*words):
        counts["data"] += 1
        return read_csv(*words)

    monkeypatch.setitem(BUILT_IN, BEAM, build)
    monkeypatch.setattr(reader, "read_csv", opened)
    return counts


@pytest.mark.parametrize("from_file", [False, True], ids=["options", "experiment"])
def test_infer_reads_its_data_and_builds_its_scene_once(count, tmp_path, from_file):
    (tmp_path / "nodes.csv").write_text(NODES)
    (tmp_path / "e.toml").write_text(f'scene = "{BEAM}"\ndata = "nodes.csv"\n')
    what = [str(tmp_path / "e.toml")]
    if not from_file:
        what = [BEAM, "--data", str(tmp_path / "nodes.csv")]
    words = ["--forward", "reduced", "--fem-runs", "6", "--sampler", "laplace", "--draws", "50"]
    words += ["--no-unit-check", "--no-certify", "--out", str(tmp_path / "r")]
    assert main(["infer", *what, *words]) == 0
    assert count == {"scene": 1, "data": 1}


def test_few_frames_lie_between_a_command_and_its_data_and_its_likelihood():
    """An experiment's data was parsed four times, by 10 frames. To the likelihood five frames are the
    sampler's, four the program's that evaluates it in blocks.
    """
    parse, likelihood = journeys.parse().frames, journeys.likelihood().frames
    assert len(parse) <= 6
    assert len(likelihood) <= 18
    assert len(dict.fromkeys([*parse, *likelihood])) <= 21
    assert parse[-1].function == "read_csv"
    assert likelihood[-1].function == "Model.distributions"


def test_a_problem_is_read_once_and_changed_without_reading(count, tmp_path):
    (tmp_path / "nodes.csv").write_text(NODES)
    problem = read_problem(Run(BEAM, data=str(tmp_path / "nodes.csv")))
    assert isinstance(problem, Problem)
    assert read_problem(problem) is with_data(problem) is problem
    assert problem.run.noise == {"displacement": 0.2}  # the default, by its name
    changed = problem.change(noise={"displacement": 0.5}, seed=3)
    assert (changed.run.noise, changed.run.seed) == ({"displacement": 0.5}, 3)
    assert count == {"scene": 1, "data": 1}


def test_a_mistake_is_reported_before_the_forward_map_is_built(count, monkeypatch):
    monkeypatch.setattr("calibrate.project.problem.build_forward", None)
    run = Run(BEAM, truth={"mu": 73.0, "lam": 61.0}, observe="nodes:4", noise={"volume": 1.0})
    with pytest.raises(em.InputError, match="noise: 'volume' is not observed"):
        infer(run)


def test_a_scene_keeps_its_simulator_and_never_gets_that_of_an_equal_scene():
    first, equal = (em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1) for _ in range(2))
    simulator = simulator_of(first, 1)
    assert simulator_of(first, 1) is simulator
    assert simulator.scene is first
    assert simulator_of(first, 2) is not simulator
    assert simulator_of(equal, 1).scene is equal


def test_fem_data_of_a_check_is_solved_in_the_load_steps_of_the_run(count, monkeypatch, tmp_path):
    def stop(_, __, *, truth, **___):
        assert truth.forward.simulator.options == NewtonOptions.load_steps(3, most=100)
        raise Stopped

    monkeypatch.setattr("calibrate.analysis.sbc.sbc", stop)
    monkeypatch.setattr(
        "calibrate.project.problem.build_forward",
        lambda problem, **_: linear_forward(problem.scene),
    )
    words = ["check", "sbc", BEAM, "--observe", "nodes:4", "--fem-data", "--load-steps", "3"]
    with pytest.raises(Stopped):
        main([*words, "--out", str(tmp_path)])


def test_fem_of_a_report_is_solved_in_the_load_steps_of_the_run(beam, monkeypatch):
    observe = cal.nodal_displacements(beam, [3, 11, 20, 30])
    model = cal.model(linear_forward(beam), observe, cal.GaussianNoise(sd=0.2))
    assert by_fem(model, 3).full.simulator is simulator_of(beam, 3)

    def stop(_, load_steps):
        assert load_steps == 3
        raise Stopped

    monkeypatch.setattr(page, "simulator_of", stop)
    posterior = cal.Posterior(None, model, {})
    with pytest.raises(Stopped):
        page.html_of(Run(BEAM, load_steps=3), posterior, None)
