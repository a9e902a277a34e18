"""Commands as solvers: what a run gets and leaves, what is run once, and how a run fails."""

import json
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest

from emulator.catalogue import find_problem
from emulator.core.errors import InputError, SolverError
from emulator.external.solver import ExternalSimulator
from emulator.fem import Status

HEAD = """
[solver]
kind = "command"
command = "{python} solve.py"
{more}
[parameters.mu]
unit = "kPa"
range = [1.0, 9.0]
[parameters.load]
range = [0.0, 2.0]
[constants]
b = 3.0
[outputs.force]
unit = "N"
"""
SOLVE = """
import json
v = json.load(open("inputs.json"))
json.dump({"force": v["mu"] * v["load"] + v["b"]}, open("outputs.json", "w"))
"""
AT = jnp.array([2.0, 0.5])


def problem(folder, solve=SOLVE, more="", after="", head=HEAD):
    """A problem whose command is the Python text ``solve``."""
    (folder / "solve.py").write_text(solve)
    (folder / "spring.toml").write_text(head.format(python=sys.executable, more=more) + after)
    return find_problem(str(folder / "spring.toml"))


def asked(scene, theta=AT):
    """The outputs of one run."""
    return np.asarray(ExternalSimulator(scene)(theta))[:, 0].tolist()


def test_values_go_in_as_json_and_outputs_come_back(tmp_path):
    assert asked(problem(tmp_path)) == [4.0]
    (folder,) = (tmp_path / "spring_runs").iterdir()
    assert json.loads((folder / "inputs.json").read_text()) == {"b": 3.0, "mu": 2.0, "load": 0.5}
    assert {"log.txt", "outputs.json", "answer.json"} < {path.name for path in folder.iterdir()}


def test_nothing_is_run_twice_until_a_file_that_the_command_names_changes(tmp_path):
    counting = SOLVE + f'\nopen({str(tmp_path / "count")!r}, "a").write("x")'
    asked(problem(tmp_path, counting))
    asked(problem(tmp_path, counting))  # another process' question
    assert (tmp_path / "count").read_text() == "x"
    before = problem(tmp_path, counting).fingerprint
    changed = problem(tmp_path, counting + "\n# changed")
    asked(changed)
    assert (tmp_path / "count").read_text() == "xx"
    assert changed.fingerprint != before


def test_a_run_that_was_killed_is_begun_again(tmp_path):
    asked(scene := problem(tmp_path))
    (folder,) = (tmp_path / "spring_runs").iterdir()
    (folder / "answer.json").unlink()
    (folder / "half").touch()
    assert asked(scene) == [4.0]
    assert not (folder / "half").exists()


def test_values_are_filled_into_words_and_templates(tmp_path):
    (tmp_path / "deck.txt").write_text("MU {mu} {unknown}")
    (tmp_path / "mesh").mkdir()
    (tmp_path / "mesh" / "a.txt").write_text("7")
    solve = """
import json, sys
deck = open("deck.txt").read().split()
assert deck[2] == "{unknown}"
force = float(deck[1]) + float(sys.argv[1]) + float(open("mesh/a.txt").read())
json.dump({"force": force}, open("outputs.json", "w"))
"""
    head = HEAD.replace("solve.py", "solve.py {{load}}")
    more = 'templates = ["deck.txt"]\nfiles = ["mesh"]'
    assert asked(problem(tmp_path, solve, more, head=head)) == [2.0 + 0.5 + 7.0]


def test_outputs_are_read_from_tables_text_and_meshes(tmp_path):
    solve = """
import meshio
open("r.csv", "w").write("t, f\\n0, 1\\n1, 2.5\\n2, 3.5\\n")
open("r.log", "w").write("force = 1.0D+01\\nforce = 2.0D+01\\n")
cells = [("line", [[0, 1]])]
u = [[0, 0, 0], [1, 2, 3]]
meshio.write("r.vtu", meshio.Mesh([[0, 0, 0], [1, 0, 0]], cells, point_data={"u": u}))
"""
    after = """file = "r.log"
pattern = 'force = (\\S+)'
[outputs.curve]
size = 2
file = "r.csv"
column = "f"
[outputs.tip]
file = "r.vtu"
field = "u"
point = 1
component = 2
"""
    assert asked(problem(tmp_path, solve, after=after)) == [20.0, 2.5, 3.5, 3.0]


def test_derivatives_of_a_run_are_taken(tmp_path):
    solve = SOLVE.replace(
        '{"force": v["mu"] * v["load"] + v["b"]}',
        '{"outputs": {"force": 1.0}, "gradients": {"force": {"mu": 0.5, "load": 2.0}}}',
    )
    simulator = ExternalSimulator(problem(tmp_path, solve))
    u = simulator(AT)
    assert np.asarray(simulator.sensitivities(u, AT))[:, :, 0].tolist() == [[0.5], [2.0]]
    without = ExternalSimulator(problem(tmp_path))
    assert np.isnan(without.sensitivities(u, AT)).all()


@pytest.mark.parametrize(
    ("solve", "more", "why"),
    [
        ("raise SystemExit('no convergence')", "", "exit status 1: no convergence"),
        ("import os, signal; os.kill(os.getpid(), 9)", "", "killed by signal 9"),
        ("import time; time.sleep(60)", "time_limit = 1.0", "stopped after 1 s"),
        (SOLVE.replace('v["mu"] *', "float('nan') *"), "", "output 'force' is nan"),
    ],
)
def test_a_run_that_fails_is_a_value_and_is_not_run_again(tmp_path, capsys, solve, more, why):
    scene = problem(tmp_path, f"open({str(tmp_path / 'count')!r}, 'a').write('x')\n{solve}", more)
    begin = time.perf_counter()
    for _ in range(2):
        solution = ExternalSimulator(scene).solve(AT)
        assert Status(int(solution.status)) is Status.FAILED
        assert not solution.converged
    assert time.perf_counter() - begin < 30.0
    assert (tmp_path / "count").read_text() == "x"
    assert why in capsys.readouterr().err
    with pytest.raises(SolverError, match=why):
        asked(scene)


@pytest.mark.parametrize(
    ("solve", "more", "after", "complaint"),
    [
        ("", "", "", "ended without outputs.json"),
        (SOLVE.replace('"force"', '"forse"'), "", "", "returned no 'force', but forse"),
        (SOLVE, "", "size = 2", "returned 1 numbers of shape"),
        (SOLVE, "", 'file = "a.csv"\ncolumn = "f"', "ended without a.csv"),
        ("open('a.csv', 'w').write('g\\n1')", "", 'file = "a.csv"\ncolumn = "f"', "but g"),
        ("open('a.txt', 'w')", "", "file = 'a.txt'\npattern = 'F (.)'", "nothing in .* matches"),
        ("open('outputs.json', 'w').write('{')", "", "", "is not valid JSON"),
        (SOLVE.replace('v["mu"] *', '"x" or'), "", "", "returned 'x', no number"),
        (SOLVE, 'templates = ["none.txt"]', "", "templates: there is no file|there is no file"),
    ],
)
def test_what_no_run_would_mend_is_an_error_of_one_line(tmp_path, solve, more, after, complaint):
    with pytest.raises(InputError, match=complaint) as error:
        asked(problem(tmp_path, solve, more, after))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("{python}", "no_such_program_{{mu}}", "there is no program 'no_such_program_2.0'"),
        ("solve.py", "solve.py {{nu}}", "{nu} is no parameter: b, mu, load"),
        ('kind = "command"', 'kind = "commnd"', 'kind = "commnd"; expected "command"'),
        ("[outputs.force]", '[outputs."a b"]', "a name has letters, digits and _"),
        ("range = [0.0, 2.0]", "", "give a range, or median and log_sd"),
        ("b = 3.0", "mu = 3.0", "two things are called 'mu'"),
        ('unit = "N"', 'unit = "N"\nfile = "a"', "file together with column"),
        ('unit = "N"', 'unit = "N"\nsize = 0', "size is 0"),
        ("[constants]", 'loads = ["q"]\n[constants]', "'q' is no parameter"),
        ("{more}", "time_limit = -1.0", "time_limit is -1"),
    ],
)
def test_mistakes_of_a_file_are_named(tmp_path, old, new, complaint):
    head = HEAD.replace(old, new)
    if new.startswith("loads"):
        head = 'loads = ["q"]\n' + HEAD
    with pytest.raises(InputError) as error:
        asked(problem(tmp_path, head=head))
    assert complaint in str(error.value)


def test_a_full_disk_is_a_failed_run(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("emulator.external.command._executed", full)
    with pytest.raises(SolverError, match="No space left"):
        asked(problem(tmp_path))
