"""The JSON Schema of experiment files says what their reader says."""

import json
import re
import textwrap
import tomllib
from dataclasses import MISSING, dataclass, fields
from pathlib import Path

import jsonschema
import pytest

import calibrate.project.experiment as reader
from calibrate.cli import main
from calibrate.model_error.kinds import SYSTEMATIC_ERRORS
from calibrate.noise import NOISES
from calibrate.priors import Population
from calibrate.project import Run
from calibrate.project.experiment import experiment_schema, read_experiment
from calibrate.project.members import Shared
from calibrate.samplers import SAMPLERS
from emulator.core.errors import InputError
from emulator.core.schema import read_as
from emulator.surrogates.registry import FORWARD_MAPS, known_options

ROOT = Path(__file__).resolve().parents[3]
NODES = "node,ux,uy,uz\n3,0.5,0.0,-9.0\n7,0.4,0.1,-5.0\n11,0.2,0.0,-2.0\n"
RIGHT = """scene = "once_clamped_beam"
data = "nodes.csv"
forward = "reduced"
forward_options = {fem_runs = 6}
prior = {median = {mu = 70.0}, log_sd = {mu = 0.2}}
sampler_options = {target_accept = 0.9, rounds = 2}
warmup = 40

[noise.displacement]
kind = "correlated"
length = 5.0
sd = 0.2
spatial_sd = 0.1
kernel = "matern32"

[systematic.camera]
kind = "rigid_motion"
of = "displacement"
shift = [0.5, 0.5, 1.0]
turn = 1
"""
MEMBERS = RIGHT.replace('data = "nodes.csv"\n', "") + (
    '[members.first]\ndata = "nodes.csv"\n[members.second]\ndata = "nodes.csv"\nseed = 3\n'
    '[population]\nshared = ["mu"]\nmedian = {mu = [70.0, 0.2]}\n'
)


@pytest.fixture(scope="module")
def validator():
    schema = experiment_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.fixture
def read(tmp_path):
    """Read an experiment file with its data beside it."""
    (tmp_path / "nodes.csv").write_text(NODES)

    def read_text(text):
        (tmp_path / "experiment.toml").write_text(text)
        return read_experiment(tmp_path / "experiment.toml")

    return read_text


def written():
    """Every experiment file in the docs, in docstrings, in the tests and in the notebooks."""
    blocks = reader.__doc__.split(".. code-block:: toml\n")[1:]
    found = [textwrap.dedent(re.split(r"\n(?=\S)", block)[0]).strip() for block in blocks]
    for page in ROOT.glob("docs/*.md"):
        found += re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    for page in [*ROOT.glob("tests/**/*.py"), *ROOT.glob("notebooks/*.py")]:
        found += re.findall(r'"""\n?(scene = .*?)"""', page.read_text(encoding="utf-8"), re.DOTALL)
    complete = [text for text in found if re.match(r"scene = ", text)]
    assert len(complete) > 7
    return dict.fromkeys(complete)


@pytest.mark.parametrize("text", written())
def test_what_the_reader_admits_the_schema_admits(validator, text):
    entries = tomllib.loads(text)
    assert not [error.message for error in validator.iter_errors(entries)]
    read_as(Shared, entries.pop("population", {}), "written")
    for own in entries.pop("members", {"": {}}).values():
        read_as(Run, {**entries, **own}, "written")


@pytest.mark.parametrize("text", [RIGHT, MEMBERS])
def test_what_is_right_is_read(validator, read, text):
    read(text)
    assert validator.is_valid(tomllib.loads(text))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("warmup = 40", "warmups = 40"),
        ("warmup = 40", 'warmup = "long"'),
        ("warmup = 40", "warmup = true"),
        ('"nodes.csv"', "7"),
        ('scene = "once_clamped_beam"\n', ""),
        ('"correlated"', '"corelated"'),
        ('kind = "correlated"\n', ""),
        ("spatial_sd = 0.1", "spatial_sd = 0.1\nrange = 3.0"),
        ("length = 5.0\n", ""),
        ('"matern32"', '"matern"'),
        ('"rigid_motion"', '"rigid_moton"'),
        ('kind = "rigid_motion"\n', ""),
        ("turn = 1", 'turn = "1 degree"'),
        ("shift = [0.5, 0.5, 1.0]", "shift = [0.5, 0.5]"),
        ("turn = 1", 'turn = 1\nat = "reference"'),
        ('"reduced"', '"reduce"'),
        ("fem_runs = 6", "fem_run = 6"),
        ("fem_runs = 6", "fem_runs = 2"),
        ("{median = {mu = 70.0}", "{medians = {mu = 70.0}"),
        ("{mu = 70.0}", '{mu = "70 kPa"}'),
        ("{median = {mu = 70.0}, log_sd = {mu = 0.2}}", '"ventricle"'),
        ("rounds = 2", "leapfrog = 2"),
        ("rounds = 2", 'rounds = "two"'),
        ("warmup = 40", 'sampler = "nut"'),
        ("[systematic", "[population]\neta = 1.0\n[systematic"),
    ],
)
def test_what_both_refuse(validator, read, old, new):
    assert old in RIGHT
    text = RIGHT.replace(old, new)
    with pytest.raises(InputError, match=r"experiment\.toml"):
        read(text)
    assert not validator.is_valid(tomllib.loads(text))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("seed = 3", "seeds = 3"),
        ("seed = 3", "noise = {displacement = {kind = 'normal', sd = 0.2}}"),
        ("shared =", "share ="),
        ("[70.0, 0.2]", "70.0"),
        ('scene = "once_clamped_beam"\n', ""),
    ],
)
def test_what_both_refuse_of_members(validator, read, old, new):
    assert old in MEMBERS
    text = MEMBERS.replace(old, new)
    with pytest.raises(InputError, match=r"experiment\.toml"):
        read(text)
    assert not validator.is_valid(tomllib.loads(text))


def test_members_may_say_all_for_themselves(validator, read):
    """Of the entries outside of the tables none is needed."""
    scene = 'scene = "once_clamped_beam"\n'
    text = MEMBERS.replace(scene, "").replace('data = "nodes', f'{scene}data = "nodes')
    read(text)
    assert validator.is_valid(tomllib.loads(text))


TABLES = [
    Run,
    Population,
    Shared,
    *NOISES.values(),
    *SYSTEMATIC_ERRORS.values(),
    *(sampler.options for sampler in SAMPLERS.values()),
]


@pytest.mark.parametrize("kind", TABLES, ids=lambda kind: kind.__name__)
def test_each_key_that_the_reader_takes_is_there_and_described(validator, kind):
    table = validator.schema["$defs"][kind.__name__]
    keys = {name: key for name, key in table["properties"].items() if name != "kind"}
    takes = {entry.name: entry for entry in fields(kind) if entry.compare}
    assert set(keys) == set(takes)
    assert not [name for name, key in keys.items() if not key.get("description")]
    needed = {n for n, e in takes.items() if e.default is e.default_factory is MISSING}
    said = {*table.get("required", ())} - {"kind"}
    assert said == (needed if kind is not Run else set())  # the file or each member, above


def test_words_and_kinds_are_those_of_the_registries(validator):
    keys, tables = validator.schema["properties"], validator.schema["$defs"]
    assert keys["forward"]["enum"] == list(FORWARD_MAPS)
    assert keys["sampler"]["enum"] == list(SAMPLERS)
    assert set(tables["ForwardOptions"]["properties"]) == set(known_options())
    for kinds in (NOISES, SYSTEMATIC_ERRORS):
        for name, kind in kinds.items():
            assert tables[kind.__name__]["properties"]["kind"]["const"] == name
    assert set(keys) == set(tables["Run"]["properties"]) | {"members", "population"}


def test_a_new_kind_is_in_the_schema_at_once(monkeypatch):
    @dataclass(frozen=True)
    class Drift:
        """A transducer that drifts.

        of : observations, joined by ``+``.
        rate : sd of the drift, in the unit of the data an hour.
        """

        of: str
        rate: float

    monkeypatch.setitem(SYSTEMATIC_ERRORS, "drift", Drift)
    found = experiment_schema()["$defs"]["Drift"]["properties"]
    assert found["kind"] == {"const": "drift", "description": "A transducer that drifts."}
    assert found["rate"]["description"] == "sd of the drift, in the unit of the data an hour."


def test_the_command_prints_it(capsys):
    assert main(["schema", "experiment"]) == 0
    assert json.loads(capsys.readouterr().out) == experiment_schema()
    assert main(["schema"]) == 0
    plain = capsys.readouterr().out
    assert main(["schema", "scene"]) == 0
    assert capsys.readouterr().out == plain
    assert json.loads(plain)["title"] == "Scene file"
