"""The folder that a run leaves: how it is written, and read again.

=========================  =========================================================================
``run.json``               the :class:`~calibrate.project.run.Run`
``data.csv``               its data
``forward.safetensors``    the forward map, where it was fitted for this run
``error.safetensors``      the systematic errors that the likelihood allows for, if any
``solutions.safetensors``  FEM's that taught the map; another run into the folder begins with them
``posterior.nc``           the posterior, as ArviZ reads it
``certificate.json``       what FEM says of the posterior, once it is certified
``report.html``            the page, once it is written
=========================  =========================================================================

``posterior.nc`` carries the run it was sampled for and the fingerprint of its forward map. A
certificate speaks about that run and that map, so any difference is refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import xarray as xr

from calibrate.measurements import leave_out_missing, observations_from_json
from calibrate.measurements.data import write_data
from calibrate.model_error import ModelError
from calibrate.posterior import Posterior, read_tree
from calibrate.project.problem import Problem, ingredients, model_of
from calibrate.project.run import Run
from calibrate.project.stated_priors import without_box
from emulator.catalogue import find_problem
from emulator.core import schema
from emulator.core.errors import InputError
from emulator.core.line_index import Path as Place
from emulator.core.line_index import json_lines
from emulator.core.store import exclusive, read_arrays, read_json, save_arrays, write_json
from emulator.surrogates import registry

RUN, DATA, POSTERIOR, CERTIFICATE = "run.json", "data.csv", "posterior.nc", "certificate.json"
FORWARD, ERROR = "forward.safetensors", "error.safetensors"
REPORT = "report.html"
SAMPLING = "sampling.safetensors"  # checkpoint of a run that has not ended
SOLUTIONS = "solutions.safetensors"  # FEM's that teach a map
POPULATION = "population"  # entry of what members share in run.json and in experiment files
MEMBERS = "members"  # entry of a population's members in run.json, and folder of their runs

_RESULTS = (REPORT, CERTIFICATE, POSTERIOR, FORWARD, ERROR)  # files of a run that has ended
_PLACES = ("scene", "root", "emulator")  # may change: fingerprints identify the content
_LEARNED = ("error_runs", "mesh_error_runs")  # entries of earlier versions' runs
_DESCRIPTION = "systematic"  # metadata of a file of systematic errors
_DATA_HASH = "data_sha256"  # attribute of a posterior: the SHA-256 of its data file
_SHOWN = 4  # largest number of a folder's files that an error names


@contextmanager
def reserved(folder: Path, results: tuple[str, ...] = _RESULTS, *, force: bool) -> Iterator[None]:
    """Reserve ``folder`` for one run of one process; ``results`` are replaced by ``force`` only."""
    with exclusive(folder / RUN, "run"):
        present = [name for name in results if (folder / name).exists()]
        if present and not force:
            raise InputError(
                f"{folder} has results of an earlier run ({', '.join(present)}); replace them with "
                "--force (in Python: force=True), or name another folder"
            )
        yield


def save_results(folder: Path, problem: Problem, posterior: Posterior) -> None:
    """Write run, data, forward map, errors and posterior in place of earlier results.

    Raises OSError, with a word on how to go on, where they cannot be written.
    """
    try:
        _replace_results(folder, problem, posterior)
    except OSError as error:
        again = f"{error.strerror}; make room and repeat the run: its seed gives its draws"
        raise OSError(error.errno, again, error.filename) from error


def _replace_results(folder: Path, problem: Problem, posterior: Posterior) -> None:
    assert problem.data is not None, "the posterior has been sampled with data"
    run = asdict(problem.run)
    with TemporaryDirectory(dir=folder, prefix=".new.") as name:
        new = Path(name)
        write_data(new / DATA, problem.observe, problem.data)
        write_json(new / RUN, run)
        registry.keep_forward(posterior.model.full, new / FORWARD)
        if (error := posterior.model.error).terms:
            save_arrays(new / ERROR, error.arrays(), {_DESCRIPTION: json.dumps(error.words)})
        posterior.tree.attrs |= {"run": json.dumps(run), _DATA_HASH: _hash(new / DATA)}
        posterior.save(new / POSTERIOR)
        # Earlier results go first and the posterior comes last: a run that is killed leaves no
        # posterior, rather than one beside the certificate of another.
        _remove(folder, _RESULTS)
        for path in sorted(new.iterdir(), key=lambda path: path.name == POSTERIOR):
            path.replace(folder / path.name)


def save_reweighted(posterior: Posterior, source: Path, target: Path) -> None:
    """Write a reweighted posterior beside copies of the run, the data and the map in ``source``."""
    target.mkdir(parents=True, exist_ok=True)
    _remove(target, _RESULTS)
    for name in (RUN, DATA, FORWARD, ERROR):
        if (source / name).exists():
            copyfile(source / name, target / name)
    posterior.save(target / POSTERIOR)


def remove_pages(folder: Path) -> None:
    """Remove the pages with an earlier verdict: the run's, and its population's."""
    _remove(folder, (REPORT,))
    above = folder.parent.parent
    if folder.parent.name == MEMBERS and (above / RUN).is_file() and holds_population(above):
        _remove(above, (REPORT,))


def _remove(folder: Path, names: tuple[str, ...]) -> None:
    for name in names:
        (folder / name).unlink(missing_ok=True)


def load(folder: str | Path) -> Posterior:
    """Return the posterior of :func:`read_posterior`, which ``calibrate infer`` wrote."""
    return read_posterior(folder)[1]


def read_posterior(folder: str | Path) -> tuple[Run, Posterior]:
    """Read the run in ``folder`` and its posterior, ready to be certified.

    Raises
    ------
    InputError
        A file is missing or damaged, or the posterior was not made with this run, its scene or its
        forward map.
    """
    folder = Path(folder)
    path = folder / POSTERIOR
    if holds_population(folder):
        raise InputError(
            f"{folder} holds a population; name one of its members, {folder / MEMBERS}/NAME"
        )
    entries, lines = read_json(folder / RUN), json_lines((folder / RUN).read_text("utf-8"))
    run = run_of(entries, str(folder / RUN), lines)
    scene = find_problem(run.scene, run.root)
    scene = without_box(run, scene)[1]
    tree = read_tree(path)
    if tree.attrs.get("scene_fingerprint") != scene.fingerprint:
        raise InputError(f"{path} was made for another scene than '{run.scene}'")
    _check_run(path, tree, entries)
    kept = tree.attrs.get(_DATA_HASH)  # runs of earlier versions have none
    if kept and (folder / DATA).is_file() and kept != _hash(folder / DATA):
        raise InputError(
            f"{folder / DATA} was edited after {path} was sampled with it; restore it, or infer "
            "again with the new data"
        )
    forward = registry.restore_forward(
        run.forward, ingredients(run, scene), run.forward_options, folder / FORWARD
    )
    if (sampled_with := tree.attrs.get("forward_fingerprint")) != forward.fingerprint:
        raise InputError(
            f"{path} was made with another {forward.kind} map (fingerprint {sampled_with}; it is "
            f"{forward.fingerprint} now); infer again"
        )
    observe = observations_from_json(scene, json.loads(tree.attrs["observe"]))
    run_model = replace(
        model_of(run, forward, observe),
        error=_read_error(folder / ERROR, path, tree) if run.systematic else ModelError(),
        check_scale=False,  # the data was checked when it was sampled, or the check was overruled
    )
    observed = tree["observed_data"]
    data = run_model.check_data(
        {n: np.asarray(observed[n]).reshape(shape) for n, shape in observe.shapes.items()}
    )
    return run, Posterior(tree, run_model, data)


def run_of(entries: Any, where: str, lines: Mapping[Place, int] = {}) -> Run:
    """Return the run of ``entries``, read from the file ``where``, whose ``lines`` they are on.

    Earlier versions learned errors of the map and of the mesh: a run with one is refused.
    """
    runs = {n: entries.get(n) for n in _LEARNED} if isinstance(entries, dict) else {}
    for name in [name for name, count in runs.items() if count]:
        raise InputError(
            f"{where}: {name} is {runs[name]}, but errors are no longer learned; infer again, with "
            "--forward rounds where the map misses FEM, and finer:SCENE where the mesh does"
        )
    present = {n: v for n, v in entries.items() if n not in runs} if runs else entries
    return schema.read_as(Run, present, where, lines)


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def holds_population(folder: str | Path) -> bool:
    """Return whether ``folder`` has the results of a population; it has those or one run's."""
    path = Path(folder) / RUN
    if not path.is_file():
        raise InputError(
            f"{path} does not exist: {_content(path.parent)}; give a folder that calibrate infer "
            "wrote, of a posterior or of a population"
        )
    entries = read_json(path)
    return isinstance(entries, dict) and isinstance(entries.get(MEMBERS), dict)


def _content(folder: Path) -> str:
    """Describe the content of a ``folder`` without results."""
    if not folder.is_dir():
        return f"{folder} is a file" if folder.exists() else "there is no such folder"
    names = sorted(path.name for path in folder.iterdir())
    more = ", ..." if len(names) > _SHOWN else ""
    return f"the folder holds {', '.join(names[:_SHOWN]) or 'nothing'}{more}"


def is_of(posterior: Posterior, problem: Problem) -> bool:
    """Return whether a posterior was sampled with the observations and the data of ``problem``."""
    assert problem.data is not None
    reduced, present = leave_out_missing(problem.observe, problem.data)
    described = json.loads(json.dumps(reduced.to_json()))
    return described == json.loads(posterior.tree.attrs["observe"]) and all(
        np.array_equal(np.ravel(present[name]), np.ravel(values))
        for name, values in posterior.data.items()
    )


def _check_run(path: Path, tree: xr.DataTree, run: Mapping[str, Any]) -> None:
    """Refuse the first entry of ``run.json`` that the posterior in ``path`` was not made with."""
    try:
        sampled: dict[str, Any] = json.loads(tree.attrs["run"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} does not name the run it was sampled for; infer again") from error
    for name in sorted({*sampled, *run} - set(_PLACES)):
        if name not in run:
            raise InputError(
                f"{path} was sampled with {name} = {json.dumps(sampled[name])}, which run.json "
                "lacks; restore it, or infer again"
            )
        if sampled.get(name) != run.get(name):
            raise InputError(
                f"{path} was sampled with {name} = {json.dumps(sampled.get(name))}, but run.json "
                f"says {json.dumps(run.get(name))}; infer again"
            )


def _read_error(path: Path, posterior: Path, tree: xr.DataTree) -> ModelError:
    """Return the errors besides noise that the likelihood of a posterior allows for."""
    if not path.is_file():
        raise InputError(f"{path}, the error in the likelihood of the posterior, is missing")
    arrays, metadata = read_arrays(path)
    try:
        error = ModelError.restore(arrays, json.loads(metadata.get(_DESCRIPTION, "{}")))
    except TypeError as wrong:
        raise InputError(f"{path} holds other arrays than an error has; infer again") from wrong
    if tree.attrs.get("forward_error") != error.fingerprint:
        raise InputError(
            f"{posterior} was sampled with another error than {path} holds; infer again"
        )
    return error
