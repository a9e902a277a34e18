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

Members of one population have a table ``[members.NAME]`` each; keys outside of these tables hold
for all members, and ``[population]`` is a :class:`~calibrate.project.members.Shared`.

The JSON Schema, for editors that complete and check TOML, has the keys, types and descriptions of
the run, of the dataclasses in the registries of noises, systematic errors and samplers, and of the
options of forward maps.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

from pydantic import Field, create_model

from calibrate.model_error.kinds import SYSTEMATIC_ERRORS
from calibrate.noise import NOISES
from calibrate.priors.population import BOX, POPULATIONS, Population
from calibrate.project.problem import Problem, naming, read_problem
from calibrate.project.results import MEMBERS, POPULATION
from calibrate.project.run import SYNTHETIC, Run
from calibrate.samplers import SAMPLERS
from emulator.core import schema
from emulator.core.errors import InputError
from emulator.core.gaussian_process import CORRELATIONS
from emulator.core.schema import OneOf, Table, documented, json_schema, table_of
from emulator.core.store import parse_text
from emulator.scenes.finer import FINER
from emulator.surrogates import shipped
from emulator.surrogates.folders import KINDS
from emulator.surrogates.registry import FORWARD_MAPS, forward_kind, known_options

if TYPE_CHECKING:
    from calibrate.project.members import Members

_OF_A_MEMBER = ("data", "truth", "known", "observe")


def is_experiment_file(word: str) -> bool:
    """Return whether ``word`` is a TOML file that names a scene or members."""
    if not word.endswith(".toml") or not Path(word).is_file():
        return False
    try:
        content = parse_text(tomllib.loads, Path(word).read_text("utf-8"))
        return bool({"scene", MEMBERS} & content.keys())
    except ValueError:
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
    path = Path(path)
    source = schema.read_toml(path, "experiment file")
    file_name, file, lines = source.name, source.data, source.lines

    def problem(table: Mapping[str, Any], table_lines: Mapping[Any, int], where: str) -> Problem:
        if "data" in table and "observe" in table and table["data"] != SYNTHETIC:
            raise InputError(
                f"{where}: observe has no effect beside data: it is for synthetic data"
            )
        run = schema.read_as(Run, _without(table, entries), where, table_lines, toml=True)
        with naming(where):
            run = replace(run, **{**with_absolute_paths(vars(run), path.parent), **entries})
        return read_problem(run, where)

    if MEMBERS not in file:
        if POPULATION in file:
            raise InputError(f"{file_name}: [population] is of members; give [members.NAME], too")
        return problem(file, lines, file_name)
    from calibrate.project.members import Members, Shared  # a room

    for name in _OF_A_MEMBER:
        if name in entries:
            raise InputError(f"--{name} has no effect with {path}: it is of one member")
    tables = file[MEMBERS]
    if not isinstance(tables, dict) or not all(isinstance(t, dict) for t in tables.values()):
        raise InputError(f"{file_name}: members are tables [members.NAME]")
    common = {k: v for k, v in file.items() if k not in (MEMBERS, POPULATION)}
    problems = {}
    for name, table in tables.items():
        member_lines = {
            at[2:]: n for at, n in lines.items() if at[:2] == (MEMBERS, name) and at[2:]
        }
        where = f"{file_name}, member '{name}'"
        problems[name] = problem({**common, **table}, {**lines, **member_lines}, where)
    population_lines = {at[1:]: n for at, n in lines.items() if at[0] == POPULATION}
    where = f"{file_name}, [population]"
    shared = schema.read_as(Shared, file.get(POPULATION, {}), where, population_lines, toml=True)
    with naming(file_name):
        runs = {name: member.run for name, member in problems.items()}
        return Members(runs, shared, problems=problems)


def with_absolute_paths(entries: Mapping[str, Any], folder: Path = Path()) -> dict[str, Any]:
    """Return the entries of a run with absolute paths, so that they hold in every folder.

    Files and folders become absolute; names of built-in scenes and shipped emulators stay. A file
    of a prior becomes its content: a run must not change with the file.

    Parameters
    ----------
    entries : some fields of a run by name.
    folder : the folder that relative paths start from.
    """

    def path(word: str) -> str:
        return str((folder / word).resolve())

    def scene(word: str) -> str:
        change, _, of = word.partition(":")
        if of and change == FINER:
            return f"{FINER}:{scene(of)}"
        return path(word) if word.endswith(".toml") else word

    def data(word: str | dict[str, str]) -> str | dict[str, str]:
        if isinstance(word, dict):
            return {state: path(file) for state, file in word.items()}
        return word if word == SYNTHETIC else path(word)

    def emulator(word: str) -> str:
        return word if word in (*shipped(), *KINDS) else path(word)

    def prior(word: str | dict[str, Any]) -> str | dict[str, Any]:
        if isinstance(word, str) and word.endswith(".json"):
            return asdict(schema.read_json_as(Population, folder / word))
        return word

    resolve: dict[str, Callable[[Any], Any]] = {
        "scene": scene, "root": path, "data": data, "emulator": emulator, "prior": prior,
    }  # fmt: skip
    return {
        name: resolve[name](value) if name in resolve and value is not None else value
        for name, value in entries.items()
    }


def _without(table: Mapping[str, Any], entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table less the entries of a forward map or of data that ``entries`` replace."""
    replaced = set[str]()
    if "forward" in entries:
        replaced.add("forward_options")
        replaced |= {"emulator"} - set(forward_kind(entries["forward"]).words)
    if entries.get("data", SYNTHETIC) != SYNTHETIC:
        replaced |= {"truth", "observe"}
    return {name: value for name, value in table.items() if name not in replaced}


def experiment_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12); it accepts the files that the reader accepts."""
    from calibrate.project.members import Members, Shared  # a room

    run: Any = _entries()
    about = documented(Members)
    tables: dict[str, Any] = {
        MEMBERS: (dict[str, run], Field(None, description=about[MEMBERS])),
        POPULATION: (table_of(Shared), Field(None, description=about[POPULATION])),
    }
    file_schema = json_schema(create_model("ExperimentFile", __base__=run, **tables))
    file_schema["description"] = "What was measured on which body, and what is not known of it."
    for table in file_schema["$defs"].values():
        if "kernel" in table["properties"]:
            table["properties"]["kernel"]["enum"] = list(CORRELATIONS)
    # An entry that the file lacks for all members is required of each member.
    file_schema["$defs"][Run.__name__].pop("required")
    whole: list[Any] = [{"dependentRequired": {POPULATION: [MEMBERS]}}]
    for key in file_schema.pop("required")[::-1]:
        members = {MEMBERS: {"additionalProperties": {"required": [key]}}}
        in_all = {"required": [MEMBERS], "properties": members}
        whole.insert(0, {"anyOf": [{"required": [key]}, in_all]})
    return {"title": "Experiment file", **file_schema, "allOf": whole}


def _entries() -> type[Table]:
    """Return the table of a run, with an exact type for entries that a run holds as plain data."""
    noise = Annotated[Any, OneOf("kind", NOISES)]
    of_maps: dict[str, Any] = {}  # of all maps: each member may choose its own
    for name, (option, _) in known_options().items():
        shown: dict[str, Any] = {"default": option.default}
        entry = Field(None, ge=option.least, description=option.help, json_schema_extra=shown)
        of_maps[name] = (int, entry)
    named, in_file = Literal[BOX, *POPULATIONS], Annotated[str, Field(pattern=r"\.json$")]
    exact: dict[str, Any] = {
        "prior": Union[named, in_file, table_of(Population)],  # noqa: UP007
        "noise": Mapping[str, float | noise] | float,
        "systematic": dict[str, Annotated[Any, OneOf("kind", SYSTEMATIC_ERRORS)]],
        "forward": Literal[tuple(FORWARD_MAPS)],
        "forward_options": create_model("ForwardOptions", __base__=Table, **of_maps),
        "sampler": Literal[tuple(SAMPLERS)],
        "sampler_options": Union[tuple(table_of(s.options) for s in SAMPLERS.values())],  # noqa: UP007
    }
    table = table_of(Run)
    entries: dict[str, Any] = {k: (hint, table.model_fields[k]) for k, hint in exact.items()}
    return create_model(Run.__name__, __base__=table, __doc__=table.__doc__, **entries)
