import json
import tomllib
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.core.line_index import toml_lines
from emulator.core.schema import OneOf, Source, Table, expectation, parse, read_json_as


@dataclass(frozen=True)
class Job:
    """A small stand-in for a run."""

    scene: str
    truth: dict[str, float] = field(default_factory=dict)
    noise: float | None = 0.2
    sampler: Literal["nuts", "smc"] = "nuts"
    draws: int = 100
    box: tuple[float, float] = (0.0, 1.0)
    names: tuple[str, ...] = ()
    verbose: bool = False

    def __post_init__(self) -> None:
        if self.draws < 1:
            raise InputError(f"draws is {self.draws}; it must be 1 or more")


@dataclass(frozen=True)
class Ball:
    radius: float
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class Rod:
    length: float


class Shapes(Table):
    name: str = ""
    shapes: tuple[
        Annotated[Ball | Rod, OneOf("kind", {"ball": Ball, "rod": Rod}, "ball")], ...
    ] = ()


def written(folder, **entries):
    path = folder / "job.json"
    path.write_text(json.dumps(entries, indent=2))
    return path


def test_a_dataclass_from_json(tmp_path):
    assert read_json_as(Job, written(tmp_path, scene="beam")) == Job("beam")
    entries = {"truth": {"mu": 3}, "noise": None, "sampler": "smc", "draws": 5, "box": [1, 2.5]}
    job = read_json_as(Job, written(tmp_path, scene="beam", names=["a"], verbose=True, **entries))
    assert job == Job("beam", {"mu": 3.0}, None, "smc", 5, (1.0, 2.5), ("a",), True)
    assert isinstance(job.truth["mu"], float)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"truth": {}}, "key 'scene' is missing; expected a string"),
        (
            {"scene": "beam", "drawss": 3},
            "line 3: unknown key 'drawss'; known: box, draws, names, noise, sampler, scene, truth, "
            "verbose; did you mean 'draws'?",
        ),
        ({"scene": 3}, "line 2: scene = 3; expected a string"),
        ({"scene": "b", "draws": "5"}, 'line 3: draws = "5"; expected a whole number'),
        ({"scene": "b", "draws": True}, "line 3: draws = true; expected a whole number"),
        ({"scene": "b", "draws": 5.5}, "line 3: draws = 5.5; expected a whole number"),
        ({"scene": "b", "draws": 0}, "line 3: draws is 0; it must be 1 or more"),
        ({"scene": "b", "noise": True}, "line 3: noise = true; expected a number"),
        ({"scene": "b", "noise": float("inf")}, "line 3: noise = Infinity; expected a number"),
        ({"scene": "b", "verbose": 1}, "line 3: verbose = 1; expected true or false"),
        ({"scene": "b", "sampler": "nut"}, 'line 3: sampler = "nut"; expected "nuts" or "smc"'),
        ({"scene": "b", "box": [1]}, "line 3: box = [1]; expected 2 numbers in brackets"),
        ({"scene": "b", "names": [1]}, "line 3: names = [1]; expected strings in brackets"),
        ({"scene": "b", "truth": {"mu": "3"}}, 'line 4: truth: mu = "3"; expected a number'),
        ({"scene": "b", "truth": 3}, "line 3: truth is 3; expected a table"),
    ],
)
def test_one_line_for_every_mistake_in_json(tmp_path, entries, message):
    path = written(tmp_path, **entries)
    with pytest.raises(InputError) as caught:
        read_json_as(Job, path)
    assert str(caught.value).startswith(str(path))
    assert str(caught.value).endswith(message)


def test_json_that_is_no_table(tmp_path):
    path = tmp_path / "job.json"
    path.write_text("[1]")
    with pytest.raises(InputError, match=r"job.json: content = \[1\]; expected a table"):
        read_json_as(Job, path)


def test_a_table_is_one_of_several_dataclasses():
    content = [{"radius": 1}, {"kind": "rod", "length": 2.0}, {"radius": 1, "centre": [1, 2, 3]}]
    first, second, third = parse(Shapes, Source("file", {"shapes": content})).shapes
    assert isinstance(first, Ball)
    np.testing.assert_array_equal(first.centre, np.zeros(3))
    assert second == Rod(2.0)
    assert third.centre == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            '[[shapes]]\nradius = 1.0\n[[shapes]]\nkind = "rdo"\n',
            'file, line 4: [[shapes]] number 2: kind = "rdo"; expected "ball" or "rod"; did you '
            "mean 'rod'?",
        ),
        (
            "[[shapes]]\nkind = 3\n",
            'file, line 2: [[shapes]] number 1: kind = 3; expected "ball" or "rod"',
        ),
        (
            '[[shapes]]\n\nkind = "rod"\nradius = 1.0\n',
            "file, line 4: [[shapes]] number 1: unknown key 'radius'; known: kind, length",
        ),
        (
            '[[shapes]]\nkind = "rod"',
            "file, line 1: [[shapes]] number 1: key 'length' is missing; expected a number",
        ),
        (
            "[[shapes]]\nradius = 1.0\ncentre = [\n1,\n2]",
            "file, line 3: [[shapes]] number 1: centre = [1, 2]; expected 3 numbers in brackets",
        ),
        (
            "[[shapes]]\nradius = 1979-05-27\n",
            'file, line 2: [[shapes]] number 1: radius = "1979-05-27"; expected a number',
        ),
        ("shapes = 3", "file, line 1: shapes = 3; expected tables [[shapes]]"),
        ("shapes = [3]", "file, line 1: [[shapes]] number 1 is 3; expected a table"),
        ('name = "a"\nshape = 1', "known: name, shapes; did you mean 'shapes'?"),
    ],
)
def test_one_line_for_every_mistake_in_toml(text, message):
    with pytest.raises(InputError) as caught:
        parse(Shapes, Source("file", tomllib.loads(text), toml_lines(text)))
    assert str(caught.value).endswith(message)


def test_a_long_value_is_shortened():
    with pytest.raises(InputError) as caught:
        parse(Shapes, Source("file", {"name": list(range(1000))}))
    assert len(str(caught.value)) < 120


@pytest.mark.parametrize(
    ("annotation", "words"),
    [
        (float, "a number"),
        (float | None, "a number"),
        (Literal[1, 2], "1 or 2"),
        (tuple[float, float, float], "3 numbers in brackets"),
        (tuple[int, ...], "whole numbers in brackets"),
        (dict[str, float], None),
        (tuple[Table, ...], None),
    ],
)
def test_expectations_in_words(annotation, words):
    assert expectation(annotation) == words
