"""Experiment files: what they say, what options replace, and what cannot be."""

import json

import numpy as np
import pytest

import emulator as em
from calibrate.cli import main
from calibrate.measurements.labels import missing_places
from calibrate.project import Run, read_posterior
from calibrate.project.experiment import read_experiment
from calibrate.project.members import Members
from cli_support import complaint, write_block
from emulator.core.errors import InputError
from emulator.core.store import read_arrays, save_arrays
from emulator.scenes.built_in import BUILT_IN

BEAM = "once_clamped_beam"
NODES = "node,ux,uy,uz\n3,0.5,0.0,-9.0\n7,0.4,0.1,-5.0\n11,0.2,0.0,-2.0\n19,0.1,0.0,-7.0\n"
ONE = """scene = "once_clamped_beam"
data = "nodes.csv"
forward = "reduced"
forward_options = {fem_runs = 6}
warmup = 40
draws = 40
chains = 2

[noise]
displacement = 0.2

[systematic.camera]
kind = "rigid_motion"
of = "displacement"
shift = 0.5
turn = 1.0
"""


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """A coarse beam under the built-in one's name."""
    scene = em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BUILT_IN, BEAM, lambda **_: scene)
        yield scene


@pytest.fixture
def file(tmp_path):
    """Write an experiment file, its data beside it, and return its path."""
    (tmp_path / "nodes.csv").write_text(NODES)

    def write(text=ONE):
        path = tmp_path / "experiment.toml"
        path.write_text(text)
        return path

    return write


def test_entries_are_those_of_a_run_and_places_are_beside_the_file(file, tmp_path):
    run = read_experiment(file()).run
    assert run == Run(
        BEAM,
        data=str(tmp_path / "nodes.csv"),
        noise={"displacement": 0.2},
        systematic={
            "camera": {"kind": "rigid_motion", "of": "displacement", "shift": 0.5, "turn": 1.0}
        },
        forward="reduced",
        forward_options={"fem_runs": 6},
        warmup=40,
        draws=40,
        chains=2,
    )


def test_scene_files_and_files_of_load_states_are_beside_it_too(file, tmp_path):
    write_block(tmp_path)
    (tmp_path / "b.csv").write_text(NODES.replace("19,", "2,"))
    text = 'scene = "scene.toml"\n[data]\na = "b.csv"\nb = "b.csv"\n'
    run = read_experiment(file(text)).run
    assert run.scene == str(tmp_path / "scene.toml")
    assert run.data == {"a": str(tmp_path / "b.csv"), "b": str(tmp_path / "b.csv")}


def test_what_is_given_replaces_entries(file, tmp_path):
    given = {"draws": 9, "noise": {"displacement": 0.5}, "forward": "fem"}
    run = read_experiment(file(), given).run
    assert (run.draws, run.noise, run.warmup) == (9, {"displacement": 0.5}, 40)
    assert (run.forward, run.forward_options) == ("fem", {})  # not those of another map


MISTAKES = [
    (("displacement = 0.2", "volume = 0.2"), "noise: 'volume' is not observed; observed: displac"),
    (('"nodes.csv"', '"none.csv"'), "none.csv does not exist"),
    (('"nodes.csv"', "7"), "line 2: data = 7; expected"),
    (("warmup = 40", "warmup = 0"), "line 5: warmup is 0; it must be 1 or more"),
    (("warmup = 40", "warmups = 40"), "line 5: unknown key 'warmups'; known: bounded, chains"),
    (("warmup = 40", 'warmup = "long"'), 'line 5: warmup = "long"; expected a whole number'),
    (("[noise]", '[known]\n"mu@high" = 60.0\n[noise]'), "'mu@high': load state 'high' is unknown"),
    (("[noise]", "[known]\nnu = 0.3\n[noise]"), "has no parameter 'nu'; it has mu, lam"),
    (("shift", "shifts"), "systematic 'camera': unknown key 'shifts'; known: about, at, of, shift"),
    (("turn = 1.0", 'turn = "1 degree"'), "systematic 'camera': turn = \"1 degree\"; expected"),
    (('of = "dis', 'of = "volume+dis'), "systematic 'camera': of: 'volume' is not observed"),
    (("rigid_motion", "wind"), "systematic 'camera': kind 'wind' is unknown; known: rigid_motion"),
    (('"once_clamped_beam"', '"beam"'), "scene 'beam' is unknown"),
    (('"once_clamped_beam"', "beam"), "is not valid TOML"),
    (("draws = 40", 'observe = "nodes:4"'), "observe has no effect beside data"),
    (("draws = 40", 'prior = "none.json"'), "none.json does not exist"),
    (
        ("draws = 40", "prior = {medians = {mu = 60.0}}"),
        "prior: unknown key 'medians'; known: corr",
    ),
    (
        ("draws = 40", "sampler_options = {jump = 2}"),
        "sampler 'auto': unknown key 'jump'; known:",
    ),
    (("draws = 40", "truth = {mu = 60.0}"), "truth has no effect beside data file"),
    (("[noise]", "[population]\neta = 1.0\n[noise]"), "[population] is of members; give [member"),
]


@pytest.mark.parametrize(("change", "message"), MISTAKES)
def test_a_mistake_is_one_line_that_names_the_file(file, change, message):
    assert change[0] in ONE
    with pytest.raises(InputError) as told:
        read_experiment(file(ONE.replace(*change)))
    assert message in str(told.value)
    assert "experiment.toml" in str(told.value)
    assert "\n" not in str(told.value)


def test_the_command_line_says_the_same(file, tmp_path, capsys):
    words = ["infer", str(file(ONE.replace("warmup", "warmups"))), "--out", str(tmp_path / "r")]
    assert "experiment.toml, line 5: unknown key 'warmups'" in complaint(capsys, *words)
    assert not list((tmp_path / "r").glob("*.nc"))
    words = ["simulate", str(file())]
    assert "unknown key 'scene'" in complaint(capsys, *words)


MEMBERS = ONE.replace('data = "nodes.csv"\n', "") + (
    '[members.first]\ndata = "nodes.csv"\n[members.second]\ndata = "nodes.csv"\nseed = 3\n'
    "[members.second.noise]\ndisplacement = 0.4\n"
)


def test_members_have_what_is_common_and_what_is_their_own(file):
    members = read_experiment(
        file(MEMBERS + "[population]\nshared = ['mu']\nspread = {mu = 0.2}\n")
    )
    assert isinstance(members, Members)
    first, second = members.members["first"], members.members["second"]
    assert (first.noise, second.noise) == ({"displacement": 0.2}, {"displacement": 0.4})
    assert (first.seed, second.seed, second.warmup) == (0, 3, 40)
    assert members.population.shared == ("mu",)
    assert members.population.spread == {"mu": 0.2}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("seed = 3", "seeds = 3"), "member 'second', line 20: unknown key 'seeds'"),
        (
            ("[members.second.noise]\ndisplacement", "[population]\nmedian.mu = [70.0]\nspread.mu"),
            "line 22: median of 'mu' is [70.0]; give median and relative sd",
        ),
        (
            ("= 0.4", "= -0.4"),
            "member 'second': displacement (mm): noise 'gaussian': standard deviation is",
        ),
        (("[members.first]", "[members.'a/b']"), "members: 'a/b' is no name"),
        (("[members.first]\n", "[other]\n"), "unknown key 'other'"),
        (("[members.second.noise]", "[population]"), "[population], line 22: unknown key 'displ"),
    ],
)
def test_a_mistake_of_a_member_names_it(file, change, message):
    assert change[0] in MEMBERS
    with pytest.raises(InputError) as told:
        read_experiment(file(MEMBERS.replace(*change)))
    assert message in str(told.value)
    assert "\n" not in str(told.value)


def test_one_member_is_no_population_and_data_are_of_one(file, capsys, tmp_path):
    text = MEMBERS[: MEMBERS.index("[members.second]")]
    with pytest.raises(InputError, match="one is no population"):
        read_experiment(file(text))
    words = ["infer", str(file(MEMBERS)), "--out", str(tmp_path / "r")]
    assert "--data has no effect" in complaint(
        capsys, *words, "--data", str(tmp_path / "nodes.csv")
    )
    words = ["identify", "before", str(file(MEMBERS))]
    assert "has members of a population" in complaint(capsys, *words)


@pytest.mark.slow
def test_identify_before_knows_the_errors_of_a_file(file, capsys):
    """A camera that moved by millimetres: far less is told of a beam that bends by nine."""

    def sds(text):
        assert main(["identify", "before", str(file(text)), "--json"]) == 0
        return json.loads(capsys.readouterr().out)["sd"]

    alone, moved = sds(ONE.split("[systematic")[0]), sds(ONE.replace("shift = 0.5", "shift = 5.0"))
    assert moved["mu"] > 2.0 * alone["mu"]
    assert all(alone[name] < moved[name] < 1.02 for name in alone)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """What ``infer`` leaves of an experiment."""
    folder = tmp_path_factory.mktemp("experiment")
    (folder / "nodes.csv").write_text(NODES.replace("-9.0", "NA"))
    (folder / "e.toml").write_text(ONE)
    words = [str(folder / "e.toml"), "--out", str(folder / "r"), "--no-unit-check", "--no-certify"]
    assert main(["infer", *words]) == 0
    return folder / "r"


def test_a_run_keeps_its_systematic_errors(kept):
    run, posterior = read_posterior(kept)
    assert run.systematic["camera"]["turn"] == 1.0
    assert posterior.model.error.names[0] == "camera shift x"
    assert missing_places(posterior.model.observe) == {
        "displacement": ["of node 3 at (75, 0, 0) mm"]
    }
    assert posterior.tree.attrs["forward_error"] == posterior.model.error.fingerprint


def test_certify_report_and_identify_take_it(kept, capsys):
    assert main(["certify", str(kept), "--draws", "25", "--no-mesh", "--json"]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["certificate"]["failed"] == 0
    assert main(["identify", "after", str(kept), "--json"]) == 0
    assert main(["report", str(kept), "--no-fem"]) == 0
    assert "rigid_motion" in (kept / "report.html").read_text(encoding="utf-8")


def test_another_error_is_refused(kept, tmp_path):
    run = json.loads((kept / "run.json").read_text())
    changed = {**run, "systematic": {"camera": {**run["systematic"]["camera"], "turn": 2.0}}}
    (kept / "run.json").write_text(json.dumps(changed))
    with pytest.raises(InputError, match="sampled with systematic = "):
        read_posterior(kept)
    (kept / "run.json").write_text(json.dumps(run))
    path = kept / "error.safetensors"
    arrays, metadata = read_arrays(path)
    save_arrays(path, {**arrays, "modes": 2.0 * arrays["modes"]}, metadata)
    with pytest.raises(InputError, match="sampled with another error than"):
        read_posterior(kept)
    save_arrays(path, {"modes": np.zeros((1, 2))}, metadata)
    with pytest.raises(InputError, match="holds other arrays than an error has"):
        read_posterior(kept)
    path.unlink()
    with pytest.raises(InputError, match="error.safetensors, the error in the likelihood"):
        read_posterior(kept)
    save_arrays(path, arrays, metadata)


def test_what_a_file_knows_is_known(file, tmp_path):
    (tmp_path / "nodes.csv").write_text("known:lam,parameter:mu\n60,70\n62,71\n")
    text = ONE[: ONE.index("[noise]")] + "[noise]\n'parameter:mu' = 1.0\n"
    read_experiment(file(text))
    with pytest.raises(InputError, match="'lam@1' is 60.0 in the data file and 61.0 beside it"):
        read_experiment(file(text + "[known]\n'lam@1' = 61.0\n"))
    with pytest.raises(InputError, match="every parameter is known"):
        read_experiment(file(text + "[known]\nmu = 61.0\n"))
