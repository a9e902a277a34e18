r"""External problems: what somebody else's solver is asked, and what it answers.

It is a function :math:`y = f(\theta)` from parameters to outputs, each output a number or several
of one unit. Calibration needs no more: where a scene's forward map gives the displacement (n, 3) of
its nodes, that of an external problem gives its n outputs, one after the other, in the first column
of as many rows, and zeros beside them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.mechanics.laws import Law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.forward_problem import ForwardProblem, Owners
from emulator.scenes.identity import Identity, described, fingerprint
from emulator.scenes.parameter_space import Parameter

_NAME = re.compile(r"[A-Za-z_]\w*")


@dataclass(frozen=True)
class Output:
    """A part of what a solver returns, under one name.

    Parameters
    ----------
    name : its name in data files.
    unit : of its numbers; empty when dimensionless.
    size : the number of its numbers.
    file : the file of a run that has it; by default ``outputs.json``, under its name.
    column : its column in that file, a CSV table of ``size`` rows, of which the last are taken.
    pattern : a regular expression whose groups are its numbers in that file, where it last matches.
    field : its point field in that file, of a format that meshio reads.
    point : the number of the point of that field, from 0. component : of a vector, from 0.
    """

    name: str = field(compare=False)  # the key of its table
    unit: str = ""
    size: int = 1
    file: str = ""
    column: str = ""
    pattern: str = ""
    field: str = ""
    point: int = 0
    component: int = 0

    def __post_init__(self) -> None:
        if _NAME.fullmatch(self.name) is None:
            raise InputError(f"output '{self.name}': a name has letters, digits and _")
        if self.size < 1:
            raise InputError(f"output '{self.name}': size is {self.size}; give 1 or more")
        ways = [word for word in ("column", "pattern", "field") if getattr(self, word)]
        if len(ways) > 1:
            raise InputError(f"output '{self.name}' has {' and '.join(ways)}; give one of them")
        if bool(ways) != bool(self.file):
            raise InputError(
                f"output '{self.name}': give its file together with column, pattern or field"
            )

    @property
    def columns(self) -> tuple[str, ...]:
        """Its columns in data files: the name, or ``name.1``, ``name.2`` and so on."""
        if self.size == 1:
            return (self.name,)
        return tuple(f"{self.name}.{k + 1}" for k in range(self.size))


class RunAnswer(NamedTuple):
    """The answer of a solver at one theta.

    outputs : all numbers, (n,), in the order of the problem's outputs.
    gradients : their derivatives (n, p) in theta; None where the solver gives none.
    """

    outputs: np.ndarray
    gradients: np.ndarray | None = None


class ExternalSolver(Protocol):
    """A way to ask a solver. Each kind is a frozen dataclass; its fields are keys of ``[solver]``.

    kind : its name in files.
    at_once : the number of runs at the same time, in threads; 1 where they share this process, None
        for as many as there are cores.
    """

    kind: ClassVar[str]

    @property
    def at_once(self) -> int | None: ...  # noqa: D102

    def run(self, problem: ExternalProblem, theta: np.ndarray) -> RunAnswer:
        """Return the answer at ``theta`` (p,).

        :class:`SolverError` where this run failed, :class:`InputError` where any run would.
        """
        ...

    def identity(self, folder: Path) -> Any:
        """Return all that the answers depend on as plain JSON; files by their content."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class ExternalProblem(ForwardProblem):
    """A solver that is not of this package, its parameters and its outputs.

    Parameters
    ----------
    name : used in messages and reports.
    solver : the way to ask it.
    parameters : entries of theta, in order.
    outputs : what it returns, in order.
    constants : further values that it gets.
    loads : the parameters that belong to a load state; the others are the same in all of them.
    folder : the folder that the solver's files are relative to.
    origin : the file that the problem was read from.
    """

    name: str
    solver: ExternalSolver
    parameters: tuple[Parameter, ...]
    outputs: tuple[Output, ...]
    constants: Mapping[str, float] = field(default_factory=dict)
    loads: tuple[str, ...] = ()
    folder: Path = Path()
    origin: Mapping[str, Any] = field(default_factory=dict)

    solved_by = "emulator.external.solver:ExternalSimulator"
    observed_by = "calibrate.external.outputs:kinds_of_outputs"
    refined_by = ""
    noun = "another program's, which has no mesh here"
    components = 1
    outside = True

    def __post_init__(self) -> None:
        for name in ("constants", "origin"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        names = [*self.parameter_names, *self.constants]
        if not self.parameters or not self.outputs:
            raise InputError(f"problem '{self.name}': give one parameter and one output or more")
        twice = [n for n in names if names.count(n) > 1]
        columns = [column for output in self.outputs for column in output.columns]
        twice += [n for n in columns if columns.count(n) > 1 or n in names]
        if twice:
            raise InputError(f"problem '{self.name}': two things are called '{twice[0]}'")
        for name in self.loads:
            if name not in self.parameter_names:
                raise InputError(f"problem '{self.name}': loads: '{name}' is no parameter")

    @property
    def usual_map(self) -> str:
        """The forward map where none is named: the rows of a table, else rounds of runs."""
        return super().usual_map if self.has_solver else cast(Any, self.solver).usual_map

    @property
    def has_solver(self) -> bool:
        """Say whether there is more than a table of runs that somebody made."""
        return not hasattr(self.solver, "usual_map")

    @property
    def load_parameters(self) -> tuple[str, ...]:
        """Entries of theta that belong to a load state."""
        return self.loads

    @property
    def node_count(self) -> int:
        """The number of all outputs' numbers."""
        return sum(output.size for output in self.outputs)

    @cached_property
    def places(self) -> dict[str, np.ndarray]:
        """The rows of the numbers of each output, by its name."""
        places, end = dict[str, np.ndarray](), 0
        for output in self.outputs:
            places[output.name] = np.arange(end, end + output.size)
            end += output.size
        return places

    def gradients(self, u: jax.Array) -> jax.Array:
        """Return zeros (1, 3, 3): outputs of another program deform nothing that is known here."""
        return jnp.zeros((1, 3, 3)) + 0.0 * u[:1, :1, None]

    @property
    def law(self) -> Law:  # type: ignore[override]
        """Raise :class:`InputError`: an external problem has no law of this package."""
        raise InputError(
            f"this needs a law, and problem '{self.name}' is solved by another program, which has "
            "its own"
        )

    def tissue_at(self, theta: jax.Array) -> Any:  # noqa: ARG002
        """Raise :class:`InputError`, as :attr:`law` does."""
        return self.law

    def values(self, theta: np.ndarray) -> dict[str, float]:
        """Return what the solver gets at ``theta`` (p,), by name."""
        of_theta = dict(zip(self.parameter_names, map(float, theta), strict=True))
        return dict(self.constants) | of_theta

    def checked(self, name: str, numbers: Any, what: str = "the solver") -> np.ndarray:
        """Return the numbers (size,) of the output ``name`` as ``what`` returned them.

        :class:`InputError` for another count or no numbers, :class:`SolverError` for NaN.
        """
        size = len(self.places[name])
        try:
            array = np.atleast_1d(np.asarray(numbers, dtype=float))
        except (TypeError, ValueError):
            raise InputError(f"output '{name}': {what} returned {numbers!r}, no number") from None
        if array.shape != (size,):
            raise InputError(
                f"output '{name}': {what} returned {array.size} numbers of shape {array.shape}; "
                f"its size is {size}"
            )
        if not np.isfinite(array).all():
            raise SolverError(f"output '{name}' is {array[~np.isfinite(array)][0]}")
        return array

    def answer(self, outputs: Any, gradients: Any = None, what: str = "the solver") -> RunAnswer:
        """Return the answer from numbers by output, and derivatives by output and parameter.

        Parameters of which an output has no derivative do not move it. Errors as of
        :meth:`checked`, and :class:`InputError` for an output that is missing.
        """
        if not isinstance(outputs, Mapping):
            raise InputError(f"{what} returned {outputs!r}; give the outputs by name")
        for output in self.outputs:
            if output.name not in outputs:
                known = ", ".join(map(str, outputs)) or "none"
                raise InputError(f"{what} returned no '{output.name}', but {known}")
        flat = [self.checked(o.name, outputs[o.name], what) for o in self.outputs]
        if not gradients:
            return RunAnswer(np.concatenate(flat))
        slopes = np.zeros((self.node_count, len(self.parameters)))
        for name, by_parameter in gradients.items():
            for parameter, numbers in by_parameter.items():
                if name in self.places and parameter in self.parameter_names:
                    column = self.parameter_names.index(parameter)
                    slopes[self.places[name], column] = self.checked(name, numbers, what)
        return RunAnswer(np.concatenate(flat), slopes)

    def _owners(self) -> Owners:
        quantities = {
            p.name: Quantity(p.name, p.unit, low=0.0 if p.low > 0.0 else -np.inf)
            for p in self.parameters
        }
        return {name: (quantity, "the solver") for name, quantity in quantities.items()}

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the solver's identity, of outputs, and of the order and box of theta."""
        description = {
            "solver": [self.solver.kind, self.solver.identity(self.folder)],
            "outputs": [described(output) for output in self.outputs],
            "constants": {name: float(value) for name, value in self.constants.items()},
            "loads": list(self.loads),
        }
        return fingerprint(self, Identity({}, {}, {}, description))

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return the title, and rows of solver, outputs and theta."""
        outputs = [f"{o.name} {f'({o.size}) ' if o.size > 1 else ''}{o.unit}" for o in self.outputs]
        ranges = [f"{p.name} {p.low:.4g} to {p.high:.4g} {p.unit}".strip() for p in self.parameters]
        return f"Problem '{self.name}'", [
            ("solver", self.solver.kind),
            ("outputs", ", ".join(text.strip() for text in outputs)),
            ("theta", ", ".join(ranges)),
        ]
