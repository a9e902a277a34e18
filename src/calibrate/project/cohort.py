"""Many subjects: the runs of a table or of a folder, one a subject, as members of a population.

A table (CSV or spreadsheet) has a row a subject: its name in ``subject``, and in further columns
what its experiment has, each where a cell is filled,

``experiment``
    an experiment file, which the other columns replace;
``scene`` or ``mesh``
    a scene (a name or a file), or a mesh of which a scene file is drafted, as ``calibrate init``
    does; a subject without either has the table of a specimen as its data;
``data``
    its data file, or ``data:STATE`` the file of a load state;
``known:NAME``, ``noise:NAME``
    a known parameter, ``NAME`` or ``NAME@STATE``; the noise of an observation;
``group``
    the group that it is shown with.

A folder has a folder for each subject, with ``experiment.toml``, or with the one table of its test.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calibrate.priors.population import BOX, population_called
from calibrate.project.experiment import read_experiment, with_absolute_paths
from calibrate.project.members import Members
from calibrate.project.problem import Problem, read_problem
from calibrate.project.rounds import by_rounds
from calibrate.project.run import Run
from emulator.core.cells import SPREADSHEETS, TEXT, Cells, read_cells
from emulator.core.errors import InputError
from emulator.core.schema import read_toml

EXPERIMENT = "experiment.toml"
_SUBJECT, _GROUP = "subject", "group"
_OF_NAMES = ("data", "known", "noise")  # fields of a run with an entry for each name


def read_cohort(path: str | Path, out: str | Path, law: str | None = None) -> Members:
    """Return the subjects of a table or a folder; their data are read later, one by one.

    Parameters
    ----------
    path : the table, or the folder of subjects' folders.
    out : the folder of the results, where scene files are drafted.
    law : the law of subjects whose scene is drafted; by default as ``calibrate init`` guesses.

    Raises
    ------
    InputError
        No such file, an unknown column, a subject without a name or twice, or fewer than two.
    """
    path, drafts = Path(path), Path(out) / "drafts"
    if path.is_dir():
        return _of_folders(path, drafts, law)
    if not path.is_file():
        raise InputError(f"{path} does not exist; give a table of subjects, or a folder of them")
    cells = read_cells(path)
    _check_columns(cells)
    runs, groups, unread = dict[str, Run](), dict[str, str](), dict[str, str]()
    for number, row in cells.rows.items():
        name = row[_SUBJECT]
        if not name or name in runs or name in unread:
            fault = "is there twice" if name else "is empty"
            raise InputError(f"{path}: row {number}, {_SUBJECT} '{name}' {fault}")
        if row.get(_GROUP):
            groups[name] = row[_GROUP]
        try:
            runs[name] = _run_of(cells, number, drafts / name, law)
        except InputError as error:
            unread[name] = str(error)
    return _members(path, runs, groups, unread)


def _members(
    path: Path, runs: dict[str, Run], groups: dict[str, str], unread: dict[str, str]
) -> Members:
    if len(runs) < 2 and unread:
        name, why = next(iter(unread.items()))
        raise InputError(f"{path}: {len(runs)} subject can be read; {name}: {why}")
    return Members(_with_one_prior(runs), groups=groups, unread=unread)


def _with_one_prior(runs: dict[str, Run]) -> dict[str, Run]:
    r"""Return the runs with one prior of each parameter, as a population needs.

    Priors of drafted scenes follow from each subject's data, and so do ranges. Of subjects whose
    log-normals of a parameter differ, with medians :math:`m_i` and log-sds :math:`s_i`, each gets
    the one of all together, :math:`\ln m = \overline{\ln m_i}` and
    :math:`s^2 = \overline{s_i^2} + \overline{(\ln m_i - \ln m)^2}`.
    """
    priors = {}
    for name, run in runs.items():
        population = population_called(by_rounds(read_problem(run)).run.prior)
        if population is not None and run.prior == BOX:
            priors[name] = population
    parameters = {name for population in priors.values() for name in population.median}
    median, log_sd = dict[str, float](), dict[str, float]()
    for parameter in sorted(parameters):
        those = [population for population in priors.values() if parameter in population.median]
        logs = np.log([population.median[parameter] for population in those])
        sds = np.array([population.log_sd[parameter] for population in those])
        median[parameter] = float(np.exp(logs.mean()))
        log_sd[parameter] = float(np.sqrt(np.mean(sds**2) + logs.var()))
    common = dict(runs)
    for name, population in priors.items():
        shared = {key: {n: of[n] for n in population.median} for key, of in
                  (("median", median), ("log_sd", log_sd))}  # fmt: skip
        source = dict.fromkeys(population.median, "of all subjects of the cohort")
        common[name] = replace(runs[name], prior={**shared, "source": source})
    return common


def _check_columns(cells: Cells) -> None:
    known = {"experiment", "scene", "mesh", "data", _SUBJECT, _GROUP}
    if _SUBJECT not in cells.words:
        raise InputError(f"{cells.path}: there is no column '{_SUBJECT}'")
    for word in cells.words:
        kind, colon, name = word.partition(":")
        if word not in known and not (colon and name and kind in _OF_NAMES):
            raise InputError(
                f"{cells.path}: column '{word}' is unknown; known: {', '.join(sorted(known))}, "
                "data:STATE, known:NAME, noise:NAME"
            )


def _run_of(cells: Cells, number: int, drafts: Path, law: str | None) -> Run:
    """Return the run of a row."""
    row = {word: cell for word, cell in cells.rows[number].items() if cell}
    entries: dict[str, Any] = {key: row[key] for key in ("scene", "data") if key in row}
    for word in row:
        kind, colon, name = word.partition(":")
        if colon and kind == "data":
            entries["data"] = {**(entries.get("data") or {}), name: row[word]}
        elif colon:
            entries.setdefault(kind, {})[name] = cells.number(number, word)
    folder = cells.path.parent
    entries = with_absolute_paths(entries, folder)
    if "experiment" in row:
        return _of_experiment(folder / row["experiment"], entries)
    if "mesh" in row:
        entries["scene"] = _drafted_scene(folder / row["mesh"], drafts, law)
    elif "scene" not in entries:
        if not isinstance(entries.get("data"), str):
            raise InputError("give a scene, a mesh, an experiment, or a specimen's table as data")
        return _of_table(Path(entries.pop("data")), drafts, law, entries)
    return Run(**entries)


def _of_folders(path: Path, drafts: Path, law: str | None) -> Members:
    runs, unread = dict[str, Run](), dict[str, str]()
    for folder in sorted(folder for folder in path.iterdir() if folder.is_dir()):
        tables = [p for p in sorted(folder.iterdir()) if p.suffix in (*TEXT, *SPREADSHEETS)]
        try:
            if (folder / EXPERIMENT).is_file():
                runs[folder.name] = _of_experiment(folder / EXPERIMENT, {})
            elif len(tables) == 1:
                runs[folder.name] = _of_table(tables[0], drafts / folder.name, law, {})
            else:
                raise InputError(
                    f"it has {len(tables)} tables and no {EXPERIMENT}; give that, or one table"
                )
        except InputError as error:
            unread[folder.name] = str(error)
    return _members(path, runs, {}, unread)


def _of_experiment(path: Path, entries: Mapping[str, Any]) -> Run:
    """Return the run of an experiment file; maps of ``entries`` are added to its own."""
    problem = read_experiment(path)
    if not isinstance(problem, Problem):
        raise InputError(f"{path} has members of its own; a subject has one run")
    run = problem.run
    if "prior" not in read_toml(path, "experiment file").data:
        run = replace(run, prior=BOX)  # not the one that follows from this subject's scene
    for name, value in entries.items():
        before = getattr(run, name)
        both = isinstance(before, Mapping) and isinstance(value, Mapping) and name != "data"
        changed: dict[str, Any] = {name: {**before, **value} if both else value}
        run = replace(run, **changed)
    return run


def _drafted_scene(mesh: Path, drafts: Path, law: str | None) -> str:
    """Return the scene file of a mesh, drafted where no earlier call did."""
    from emulator.scenes.draft import draft_scene

    out = drafts.with_suffix(".toml")
    if not out.exists():
        out.parent.mkdir(parents=True, exist_ok=True)
        draft_scene(mesh, out, law=law)
    return str(out.resolve())


def _of_table(table: Path, drafts: Path, law: str | None, entries: Mapping[str, Any]) -> Run:
    """Return the run of a specimen's table, drafted where no earlier call did."""
    from calibrate.project.specimen import draft_specimen  # a room

    out = drafts.with_suffix(".toml")
    if not out.exists():
        draft_specimen(table, out, law=law)
    return _of_experiment(out, entries)


def with_settings(cohort: Members, settings: Mapping[str, Any]) -> Members:
    """Return the cohort with fields of all its runs replaced, such as ``draws``."""
    runs = {name: replace(run, **settings) for name, run in cohort.members.items()}
    return replace(cohort, members=runs)
