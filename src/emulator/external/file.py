"""Files of external problems: ``[solver]``, ``[parameters]`` and ``[outputs]``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from emulator.core.errors import InputError
from emulator.core.schema import OneOf, Source, Table, parse, table_of
from emulator.external.bridge import Bridge
from emulator.external.command import Command
from emulator.external.function import Function
from emulator.external.problem import ExternalProblem, ExternalSolver, Output
from emulator.external.rows import Rows
from emulator.scenes.file_schema import ParameterTable
from emulator.scenes.parameter_space import Parameter

SOLVERS: dict[str, type] = {kind.kind: kind for kind in (Command, Function, Bridge, Rows)}
"""Ways to ask a solver, by their names in files."""


class ProblemFile(Table):
    """A whole file of an external problem."""

    solver: Annotated[Any, OneOf("kind", SOLVERS)]
    """how somebody else's solver is asked."""
    parameters: dict[str, ParameterTable]
    """what varies, with a range or a log-normal prior."""
    outputs: dict[str, table_of(Output)]  # type: ignore[valid-type]
    """what the solver returns, by name."""
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
            outputs.append(Output(name, **entry.model_dump(exclude_unset=True)))
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
