"""Experiment files: what was measured on which body, and what is not known of it, in one TOML.

The entries are those of a :class:`~calibrate.project.run.Run`, and paths are relative to the file:

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

Members of one population have a table each; what stands outside of them holds for all:

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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from calibrate.places import absolute, emulator_place, prior_place, scene_place
from calibrate.project.run import Run
from calibrate.project.workflow import MEMBERS, check_names
from emulator.core import schema
from emulator.core.errors import InputError
from emulator.core.line_index import Path as Entry
from emulator.core.line_index import toml_lines
from emulator.surrogates.registry import forward_kind

POPULATION = "population"
_OF_A_MEMBER = ("data", "truth", "known", "observe")


@dataclass(frozen=True)
class Shared:
    """What members of a population have in common, as of :func:`calibrate.hierarchy`.

    shared : unknowns that follow the population; by default all that every member has.
    median : median and relative sd of a log-normal prior of the population's median, by name.
    spread : scale of the half-normal prior of the population's sd, by name.
    eta : of the prior of correlations; 1 is uniform, more prefers none.
    """

    shared: tuple[str, ...] | None = None
    median: dict[str, list[float]] = field(default_factory=dict)
    spread: dict[str, float] = field(default_factory=dict)
    eta: float = 2.0

    def __post_init__(self) -> None:
        for name, numbers in self.median.items():
            if len(numbers) != 2:
                raise InputError(f"median of '{name}' is {numbers}; give median and relative sd")


@dataclass(frozen=True)
class Cohort:
    """Members of one population.

    members : the run of each by itself, by name.
    population : what they share.
    """

    members: Mapping[str, Run]
    population: Shared = Shared()

    def __post_init__(self) -> None:
        if len(self.members) < 2:
            raise InputError(
                "members: one is no population; give two tables [members.NAME] or more"
            )
        for name in self.members:
            if not name or set("/@[]") & set(name):
                raise InputError(f"members: '{name}' is no name; leave out /, @ and brackets")

    @property
    def first(self) -> Run:
        """The first member's run: sampler, length and seed are those of all members together."""
        return next(iter(self.members.values()))


@dataclass(frozen=True)
class _File:
    """A parsed file: folder, entries, and the line of each."""

    path: Path
    entries: dict[str, Any]
    lines: Mapping[Entry, int]

    @property
    def name(self) -> str:
        return f"experiment file {self.path}"


def read_experiment(path: str | Path, given: Mapping[str, Any] = {}) -> Run | Cohort:
    """The run, or the members, of an experiment file; ``given`` replaces entries of it.

    Raises
    ------
    InputError
        One line naming the file, its line and key, what was found and what would be right.
    """
    file = _read(Path(path))
    if MEMBERS not in file.entries:
        if POPULATION in file.entries:
            raise InputError(f"{file.name}: [population] is of members; give [members.NAME], too")
        return _run(file, file.entries, file.lines, file.name, given)
    return _cohort(file, given)


def _read(path: Path) -> _File:
    if not path.is_file():
        raise InputError(f"experiment file {path} does not exist")
    try:
        text = path.read_text(encoding="utf-8")
        return _File(path, tomllib.loads(text), toml_lines(text))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"experiment file {path} is not valid TOML: {error}") from error


def _cohort(file: _File, given: Mapping[str, Any]) -> Cohort:
    for name in _OF_A_MEMBER:
        if name in given:
            raise InputError(f"--{name} has no effect with {file.path}: it is of one member")
    tables = file.entries[MEMBERS]
    if not isinstance(tables, dict) or not all(isinstance(t, dict) for t in tables.values()):
        raise InputError(f"{file.name}: members are tables [members.NAME]")
    common = {k: v for k, v in file.entries.items() if k not in (MEMBERS, POPULATION)}
    members = {}
    for name, table in tables.items():
        own = {at[2:]: n for at, n in file.lines.items() if at[:2] == (MEMBERS, name) and at[2:]}
        where = f"{file.name}, member '{name}'"
        members[name] = _run(file, {**common, **table}, {**file.lines, **own}, where, given)
    lines = {at[1:]: n for at, n in file.lines.items() if at[0] == POPULATION}
    shared = schema.read_as(
        Shared, file.entries.get(POPULATION, {}), f"{file.name}, [population]", lines, toml=True
    )
    with _at(file.name):
        return Cohort(members, shared)


def _run(
    file: _File,
    entries: Mapping[str, Any],
    lines: Mapping[Entry, int],
    where: str,
    given: Mapping[str, Any],
) -> Run:
    """The run of some entries, its places absolute, checked against its scene and data."""
    if "data" in entries and "observe" in entries and entries["data"] != "synthetic":
        raise InputError(f"{where}: observe has no effect beside data: it is for synthetic data")
    run = schema.read_as(Run, _without(entries, given), where, lines, toml=True)
    with _at(where):
        run = replace(_placed(run, file.path.parent), **given)
        check_names(run)
    return run


def _without(entries: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Entries less those of a forward map or data that something ``given`` takes the place of."""
    gone = set[str]()
    if "forward" in given:
        gone.add("forward_options")
        gone |= set() if forward_kind(given["forward"]).from_emulator else {"emulator"}
    if given.get("data", "synthetic") != "synthetic":
        gone |= {"truth", "observe"}
    return {name: value for name, value in entries.items() if name not in gone}


def _placed(run: Run, folder: Path) -> Run:
    data = run.data
    if isinstance(data, dict):
        data = {state: absolute(file, folder) for state, file in data.items()}
    elif data != "synthetic":
        data = absolute(data, folder)
    return replace(
        run,
        scene=scene_place(run.scene, folder),
        root=run.root and absolute(run.root, folder),
        data=data,
        emulator=emulator_place(run.emulator, folder),
        prior=prior_place(run.prior, folder) if isinstance(run.prior, str) else run.prior,
    )


@contextmanager
def _at(where: str) -> Iterator[None]:
    """Have every mistake begin with where it is."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
