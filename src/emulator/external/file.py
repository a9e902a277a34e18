"""Files of external problems: ``[solver]``, ``[parameters]`` and ``[outputs]``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from emulator.core.errors import InputError
from emulator.core.schema import OneOf, Source, Table, parse
from emulator.external.bridge import Bridge
from emulator.external.command import Command
from emulator.external.function import Function
from emulator.external.problem import ExternalProblem, ExternalSolver, Output
from emulator.external.rows import Rows
from emulator.scenes.file_schema import ParameterTable
from emulator.scenes.parameter_space import Parameter

SOLVERS: dict[str, type] = {kind.kind: kind for kind in (Command, Function, Bridge, Rows)}
"""Ways to ask a solver, by their names in files."""


class OutputTable(Table):
    """One output, and where a command leaves it."""

    unit: str = ""
    """of its numbers; left out when dimensionless."""
    size: int = 1
    """the number of its numbers."""
    file: str = ""
    """file of a run; by default outputs.json, under its name."""
    column: str = ""
    """column of that file, a CSV table; the last rows are taken, as many as its size."""
    pattern: str = ""
    """regular expression whose groups are its numbers, where it last matches."""
    field: str = ""
    """point field of that file, of any format that meshio reads."""
    point: int = 0
    """number of the point of that field, from 0."""
    component: int = 0
    """component of a vector at that point, from 0."""


class ProblemFile(Table):
    """A whole file of an external problem."""

    solver: Annotated[Any, OneOf("kind", SOLVERS)]
    """how somebody else's solver is asked."""
    parameters: dict[str, ParameterTable]
    """what varies, with a range or a log-normal prior."""
    outputs: dict[str, OutputTable]
    """what the solver returns."""
    constants: dict[str, float] = Field(default_factory=dict)
    """further values that it gets."""
    loads: tuple[str, ...] = ()
    """parameters of a load state, such as a pressure; the others are the same in all states."""


def read_external(path: Path, source: Source, parameter: Any) -> ExternalProblem:
    """Return the problem of a file that has been read.

    parameter : the function of name, table and quantities that makes a parameter.
    """
    file = parse(ProblemFile, source)
    solver: ExternalSolver = file.solver
    outputs, parameters = list[Output](), list[Parameter]()
    for name, entry in file.outputs.items():
        with source.at("outputs", name, table=("outputs", name)):
            outputs.append(Output(name, **entry.model_dump()))
    for name, table in file.parameters.items():
        with source.at("parameters", name, table=("parameters", name)):
            parameters.append(parameter(name, table, ()))
    try:
        return ExternalProblem(
            name=path.stem,
            solver=solver,
            parameters=tuple(parameters),
            outputs=tuple(outputs),
            constants=file.constants,
            loads=file.loads,
            folder=path.parent.resolve(),
            origin={"scene": "file", "path": str(path.resolve())},
        )
    except InputError as error:
        raise source.error(str(error)) from error
