"""A solver that is a command: a run is a folder with its deck, its log and its outputs.

Values go to the command as ``{mu}`` in its words, as ``{mu}`` in copies of its templates, and as
JSON by name in ``inputs.json``. Outputs come from ``outputs.json``, by name, or from where each
output says (:class:`~emulator.external.problem.Output`). ``outputs.json`` may have derivatives,
``{"outputs": {...}, "gradients": {"force": {"mu": 0.3}}}``.

A run is called by a hash of its values, of the command, and of all files that either names. So what
ended is never run again, whoever asks; a script that changes has runs of its own.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.core.store import write_json
from emulator.external.problem import ExternalProblem, Output, RunAnswer

INPUTS, OUTPUTS, LOG, ENDED = "inputs.json", "outputs.json", "log.txt", "answer.json"
"""Files of a run's folder: its values, its outputs, what it printed, and how it ended."""
_PLACEHOLDER = re.compile(r"\{(\w+)\}")
_TAIL = 120  # characters of a log that an error shows


@dataclass(frozen=True)
class Command:
    """A command that is run once for each theta, in a folder of its own.

    Parameters
    ----------
    command : its words; ``{mu}`` is the value of mu. Words that name a file beside this one are
        that file's path.
    templates : files of which a run gets copies, with values in place of ``{mu}``.
    files : files and folders of which a run gets copies as they are.
    time_limit : seconds after which a run is stopped, and has failed.
    runs : the folder of all runs; by default called as the problem's file, with ``_runs``.
    at_once : the number of runs at the same time; by default the number of cores.
    """

    command: str
    templates: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    time_limit: float = 3600.0
    runs: str = ""
    at_once: int | None = None

    kind = "command"

    def __post_init__(self) -> None:
        try:
            words = shlex.split(self.command)
        except ValueError as error:
            raise InputError(f"command = '{self.command}': {error}") from None
        if not words:
            raise InputError("command is empty; give the words of a command")
        if not self.time_limit > 0.0:
            raise InputError(f"time_limit is {self.time_limit:g}; give seconds above 0")

    def run(self, problem: ExternalProblem, theta: np.ndarray) -> RunAnswer:
        """Return the answer at ``theta`` (p,), of the run that ended, or of a new one."""
        values = problem.values(theta)
        folder = self._folder(problem, values)
        record = _record_of(folder)
        if record is None:
            try:
                record = self._run(problem, values, folder)
            except OSError as error:  # a full disk, no permission
                raise SolverError(f"run {folder}: {error}") from error
        if "failed" in record:
            raise SolverError(f"run {folder}: {record['failed']}")
        return problem.answer(record["outputs"], record.get("gradients"), f"run {folder}")

    def _folder(self, problem: ExternalProblem, values: Mapping[str, float]) -> Path:
        content = [self.identity(problem.folder), sorted(values.items()), [
            [o.name, o.file, o.column, o.pattern, o.field, o.point, o.component, o.size]
            for o in problem.outputs
        ]]  # fmt: skip
        name = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
        return problem.folder / (self.runs or f"{problem.name}_runs") / name

    def _run(
        self, problem: ExternalProblem, values: Mapping[str, float], folder: Path
    ) -> dict[str, Any]:
        """Run the command in ``folder`` and return how it ended, which is kept there."""
        words = self._words(problem, values)
        if folder.exists():
            shutil.rmtree(folder)  # of a run that was killed
        folder.mkdir(parents=True)
        for name in self.files:
            _copy(_inside(problem.folder, name, "files"), folder / Path(name).name)
        for name in self.templates:
            text = _inside(problem.folder, name, "templates").read_text(encoding="utf-8")
            filled = _filled(text, values, f"template {name}", strict=False)
            (folder / Path(name).name).write_text(filled, encoding="utf-8")
        write_json(folder / INPUTS, dict(values))
        failed = _executed(words, folder, self.time_limit)
        record = {"failed": failed} if failed else _outputs_in(folder, problem)
        write_json(folder / ENDED, record)
        return record

    def _words(self, problem: ExternalProblem, values: Mapping[str, float]) -> list[str]:
        words = [_filled(word, values, "command") for word in shlex.split(self.command)]
        beside = [problem.folder.resolve() / word for word in words]
        words = [str(path) if path.is_file() else w for w, path in zip(words, beside, strict=True)]
        if shutil.which(words[0]) is None:
            raise InputError(f"command: there is no program '{words[0]}'")
        return words

    def identity(self, folder: Path) -> Any:
        """Return the command's words, and all files that it names by their content."""
        words = [word for word in shlex.split(self.command) if (folder / word).is_file()]
        files = [*words, *self.templates, *self.files]
        return [self.command, [[n, _content(_inside(folder, n, "files"))] for n in files]]


def _record_of(folder: Path) -> dict[str, Any] | None:
    """Return how the run of a folder ended; None where it has not."""
    try:
        return dict(json.loads((folder / ENDED).read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return None


def _inside(folder: Path, name: str, what: str) -> Path:
    path = folder / name
    if not path.exists():
        raise InputError(f"{what}: there is no file {path}")
    return path


def _content(path: Path) -> str:
    """Return a hash of a file, or of all files of a folder."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for file in files:
        if file.is_file():
            digest.update(str(file.relative_to(path)).encode() + file.read_bytes())
    return digest.hexdigest()


def _copy(source: Path, target: Path) -> None:
    (shutil.copytree if source.is_dir() else shutil.copyfile)(source, target)


def _filled(text: str, values: Mapping[str, float], what: str, *, strict: bool = True) -> str:
    """Return ``text`` with values in place of ``{name}``.

    strict : whether a name without a value is refused; a deck may have braces of its own.
    """

    def value(match: re.Match[str]) -> str:
        if match[1] in values:
            return repr(float(values[match[1]]))
        if strict:
            raise InputError(f"{what}: {match[0]} is no parameter: {', '.join(values)}")
        return match[0]

    return _PLACEHOLDER.sub(value, text)


def _executed(words: list[str], folder: Path, limit: float) -> str:
    """Run a command in a folder, with a log; return why it failed, empty where it did not."""
    with open(folder / LOG, "wb") as log:  # noqa: PTH123
        process = subprocess.Popen(
            words, cwd=folder, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            return f"stopped after {limit:g} s"
        finally:
            if process.poll() is None:  # out of time, or interrupted: with all that it started
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    if code == 0:
        return ""
    lines = (folder / LOG).read_text(encoding="utf-8", errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "no output")
    how = f"exit status {code}" if code > 0 else f"killed by signal {-code}"
    return f"{how}: {last[-_TAIL:]}"


def _outputs_in(folder: Path, problem: ExternalProblem) -> dict[str, Any]:
    """Return the outputs that a run left, as it is kept; or why it has none."""
    record: dict[str, Any] = {"outputs": {}}
    if any(not output.file for output in problem.outputs):
        content = _json_in(folder / OUTPUTS)
        if "gradients" in content:
            record["gradients"] = content["gradients"]
        record["outputs"] = dict(content.get("outputs", content))
    for output in problem.outputs:
        if output.file:
            record["outputs"][output.name] = _read(folder, output)
    try:
        problem.answer(record["outputs"], record.get("gradients"), f"run {folder}")
    except SolverError as error:  # not finite
        return {"failed": str(error)}
    return record


def _json_in(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            f"run {path.parent} ended without {path.name}; write it there, by name, or say of each "
            "output where it is: file, and column, pattern or field"
        ) from None
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON: {error}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path} has no outputs by name")
    return content


def _read(folder: Path, output: Output) -> list[float]:
    """Return the numbers of an output from its file in a run's folder."""
    path = folder / output.file
    if not path.is_file():
        raise InputError(f"output '{output.name}': run {folder} ended without {output.file}")
    if output.pattern:
        return _by_pattern(path, output)
    return _by_column(path, output) if output.column else _by_field(path, output)


def _by_pattern(path: Path, output: Output) -> list[float]:
    text = path.read_text(encoding="utf-8", errors="replace")
    matches = list(re.finditer(output.pattern, text))
    if not matches:
        raise InputError(f"output '{output.name}': nothing in {path} matches {output.pattern!r}")
    groups = matches[-1].groups() or (matches[-1].group(),)
    return [_number(group, output, path) for group in groups]


def _by_column(path: Path, output: Output) -> list[float]:
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        rows = list(csv.DictReader(file, skipinitialspace=True))
    if not rows or output.column not in rows[0]:
        columns = ", ".join(rows[0]) if rows else "no rows"
        raise InputError(
            f"output '{output.name}': {path} has no column '{output.column}', but {columns}"
        )
    if len(rows) < output.size:
        raise InputError(f"output '{output.name}': {path} has {len(rows)} rows, not {output.size}")
    return [_number(row[output.column], output, path) for row in rows[-output.size :]]


def _by_field(path: Path, output: Output) -> list[float]:
    import meshio

    try:
        values = np.asarray(meshio.read(path).point_data[output.field])
        row = np.atleast_1d(values[output.point])
    except (KeyError, IndexError) as error:
        raise InputError(f"output '{output.name}': {path} has no such entry: {error}") from None
    except Exception as error:
        raise InputError(f"output '{output.name}': {path} is no mesh file: {error}") from None
    if output.size > 1:
        return [float(value) for value in row]
    return [float(row[output.component])]


def _number(text: str, output: Output, path: Path) -> float:
    try:
        return float(text.replace("D", "E").replace("d", "e"))
    except (ValueError, AttributeError):
        raise InputError(f"output '{output.name}': '{text}' in {path} is no number") from None
