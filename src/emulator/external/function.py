"""A solver that is a Python function: ``function(mu=..., pressure=...)`` returns its outputs."""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.external.problem import ExternalProblem, RunAnswer


@dataclass(frozen=True)
class Function:
    """A function of a Python file, called with every parameter and constant by name.

    It returns its outputs by name, or these and their derivatives by output and parameter. A run
    failed where it raises an error, or an output is not finite.

    Parameters
    ----------
    function : file and name, such as ``model.py:solve``; the file is relative to this one.
    at_once : the number of calls at the same time, in threads.
    """

    function: str
    at_once: int = 1

    kind = "python"

    def _place(self, folder: Path) -> tuple[Path, str]:
        file, colon, name = self.function.rpartition(":")
        if not colon or not name.isidentifier():
            raise InputError(f"function = '{self.function}'; give file and name: 'model.py:solve'")
        path = folder / file
        if not path.is_file():
            raise InputError(f"function: there is no file {path}")
        return path, name

    @cached_property
    def _functions(self) -> dict[Path, Callable[..., Any]]:
        return {}

    def _called(self, folder: Path) -> Callable[..., Any]:
        """Return the function, whose file is executed once."""
        if folder not in self._functions:
            path, name = self._place(folder)
            spec = importlib.util.spec_from_file_location(path.stem, path)
            assert spec is not None
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            try:
                spec.loader.exec_module(module)
                self._functions[folder] = getattr(module, name)
            except Exception as error:
                raise InputError(f"{path}: {type(error).__name__}: {error}") from error
        return self._functions[folder]

    def run(self, problem: ExternalProblem, theta: np.ndarray) -> RunAnswer:
        """Return the function's answer at ``theta`` (p,)."""
        function = self._called(problem.folder)
        try:
            returned = function(**problem.values(theta))
        except Exception as error:
            raise SolverError(f"{self.function}: {type(error).__name__}: {error}") from error
        both = returned if isinstance(returned, tuple) else (returned, None)
        if len(both) != 2:
            raise InputError(
                f"{self.function} returned {len(both)} things; give outputs, or these and "
                "derivatives"
            )
        return problem.answer(*both, what=self.function)

    def identity(self, folder: Path) -> Any:
        """Return the function's name and its file's content."""
        path, name = self._place(folder)
        return [name, hashlib.sha256(path.read_bytes()).hexdigest()]
