"""Experiment files: a run in one TOML, or the runs of members of one population.

The keys are the fields of a :class:`~calibrate.project.run.Run`, and paths are relative to the
file:

.. code-block:: toml

    scene = "beam.toml"                      # or a built-in one; several bodies: [[bodies]] there
    forward = "reduced"

    [data]                                   # a file for each load state, or data = "measured.csv"
    weight = "weight.csv"
    loaded = "loaded.csv"

    [known]
    "hung@weight" = 0.0
    "hung@loaded" = 0.51

    [noise]
    "markers:right" = 0.1

    [systematic.camera]                      # errors that many numbers share
    kind = "rigid_motion"
    of = "markers:right@loaded"
    shift = 2.0                              # mm
    turn = 1.5                               # degrees

Members of one population have a table each; keys outside of these tables hold for all members:

.. code-block:: toml

    scene = "heart.toml"
    noise = {volume = 2.0}

    [members.first]
    data = "first.csv"

    [members.second]
    scene = "second.toml"
    data = "second.csv"

    [population]
    shared = ["a", "b"]
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calibrate.project.members import POPULATION, Members, Shared
from calibrate.project.problem import Problem, naming, read_problem
from calibrate.project.results import MEMBERS
from calibrate.project.run import SYNTHETIC, Run, with_absolute_paths
from emulator.core import schema
from emulator.core.errors import InputError
from emulator.core.line_index import Path as Entry
from emulator.core.line_index import toml_lines
from emulator.surrogates.registry import forward_kind

_OF_A_MEMBER = ("data", "truth", "known", "observe")


@dataclass(frozen=True)
class _File:
    """A parsed file: its path, its entries, and the line of each."""

    path: Path
    entries: dict[str, Any]
    lines: Mapping[Entry, int]

    @property
    def name(self) -> str:
        return f"experiment file {self.path}"


def is_experiment_file(word: str) -> bool:
    """Return whether ``word`` is a TOML file that names a scene or members."""
    if not word.endswith(".toml") or not Path(word).is_file():
        return False
    try:
        return bool({"scene", MEMBERS} & tomllib.loads(Path(word).read_text("utf-8")).keys())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        return False  # the reader of scenes reports it


def read_experiment(path: str | Path, entries: Mapping[str, Any] = {}) -> Problem | Members:
    """Read an experiment file: the problem of one run, or the members of a population.

    Scenes are built, data is parsed and names are checked (:func:`read_problem`).

    Parameters
    ----------
    path : the file.
    entries : fields of a run that replace those of the file.

    Raises
    ------
    InputError
        One line naming the file, its line and key, what was found and what would be right.
    """
    file = _read(Path(path))
    if MEMBERS not in file.entries:
        if POPULATION in file.entries:
            raise InputError(f"{file.name}: [population] is of members; give [members.NAME], too")
        return _problem(file, file.entries, file.lines, file.name, entries)
    return _members(file, entries)


def _read(path: Path) -> _File:
    if not path.is_file():
        raise InputError(f"experiment file {path} does not exist")
    try:
        text = path.read_text(encoding="utf-8")
        return _File(path, tomllib.loads(text), toml_lines(text))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"experiment file {path} is not valid TOML: {error}") from error


def _members(file: _File, entries: Mapping[str, Any]) -> Members:
    for name in _OF_A_MEMBER:
        if name in entries:
            raise InputError(f"--{name} has no effect with {file.path}: it is of one member")
    tables = file.entries[MEMBERS]
    if not isinstance(tables, dict) or not all(isinstance(t, dict) for t in tables.values()):
        raise InputError(f"{file.name}: members are tables [members.NAME]")
    common = {k: v for k, v in file.entries.items() if k not in (MEMBERS, POPULATION)}
    problems = {}
    for name, table in tables.items():
        member_lines = {
            at[2:]: n for at, n in file.lines.items() if at[:2] == (MEMBERS, name) and at[2:]
        }
        where = f"{file.name}, member '{name}'"
        lines = {**file.lines, **member_lines}
        problems[name] = _problem(file, {**common, **table}, lines, where, entries)
    lines = {at[1:]: n for at, n in file.lines.items() if at[0] == POPULATION}
    shared = schema.read_as(
        Shared, file.entries.get(POPULATION, {}), f"{file.name}, [population]", lines, toml=True
    )
    with naming(file.name):
        return Members({name: each.run for name, each in problems.items()}, shared, problems)


def _problem(
    file: _File,
    table: Mapping[str, Any],
    lines: Mapping[Entry, int],
    where: str,
    entries: Mapping[str, Any],
) -> Problem:
    """Return the problem of one table, with ``entries`` in place of the table's own."""
    if "data" in table and "observe" in table and table["data"] != SYNTHETIC:
        raise InputError(f"{where}: observe has no effect beside data: it is for synthetic data")
    run = schema.read_as(Run, _without(table, entries), where, lines, toml=True)
    with naming(where):
        run = replace(run, **{**with_absolute_paths(vars(run), file.path.parent), **entries})
    return read_problem(run, where)


def _without(table: Mapping[str, Any], entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table less the entries of a forward map or of data that ``entries`` replace."""
    replaced = set[str]()
    if "forward" in entries:
        replaced.add("forward_options")
        replaced |= set() if forward_kind(entries["forward"]).from_emulator else {"emulator"}
    if entries.get("data", SYNTHETIC) != SYNTHETIC:
        replaced |= {"truth", "observe"}
    return {name: value for name, value in table.items() if name not in replaced}
