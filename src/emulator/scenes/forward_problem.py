"""The base of scenes and specimens: a law, its parameters, and theta in its box.

A :class:`~emulator.scenes.scene.Scene` adds a mesh with loads and supports, a
:class:`~emulator.specimens.specimen.Specimen` the homogeneous states of a piece of tissue, an
:class:`~emulator.external.problem.ExternalProblem` somebody else's solver. Forward maps, priors and
calibration need no more of them than what is here.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import jax
import numpy as np

from emulator.core.cells import Cells
from emulator.core.display import TableRepr
from emulator.core.errors import InputError
from emulator.geometry.fibres import check_across, checked_directions
from emulator.mechanics.laws import Law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.fibre_rules import FibreRule
from emulator.scenes.parameter_space import Parameter, ParameterSpace
from emulator.scenes.part import BoundaryCondition, Load
from emulator.scenes.tissue import (
    FibreAngles,
    Tissue,
    at_every_point,
    effective_angles,
    stiffness_quantities,
)

Owners = dict[str, tuple[Quantity, str]]
"""Parameters by name, each with the words for what takes it."""


class ForwardProblem(TableRepr):
    """A law in tissue, its parameters and constants; the fields are those of the subclasses.

    solved_by : the module and the name of the class or function that makes its solver.
    observed_by : the module and the name of the function that returns the kinds of observation.
    refined_by : the module and the name of the function that returns FEM of higher fidelity; empty
        where there is none.
    noun : what it is, where a mesh at rest is asked for.
    components : the numbers in a row of an answer that is not the displacement of one mesh; else 0.
    outside : whether a program of somebody else's solves it.
    timed : whether times are a load's, in theta, where something resists motion.
    is_step : whether it is a step of a problem in time, whose past is known.
    """

    solved_by: ClassVar[str] = "emulator.fem.simulator:Simulator"
    observed_by: ClassVar[str] = "calibrate.measurements.words:kinds_of_bodies"
    refined_by: ClassVar[str] = "calibrate.statistical_model.gripped_fem:gripped_fem"
    noun: ClassVar[str] = "a specimen, which has no mesh"
    components: ClassVar[int] = 0
    outside: ClassVar[bool] = False
    timed: ClassVar[bool] = True
    is_step: ClassVar[bool] = False

    name: str
    law: Law
    parameters: tuple[Parameter, ...]
    constants: Mapping[str, float]
    origin: Mapping[str, Any]
    fibres: np.ndarray | None = None
    sheets: np.ndarray | None = None
    fibre_rule: FibreRule | None = None
    angles: tuple[FibreAngles, ...] = ()
    regions: np.ndarray | None = None
    loaded_by: Mapping[str, str] = MappingProxyType({})
    table: Cells | None = None
    viscosity: Any = None
    inertia: Any = None
    supports: tuple[BoundaryCondition, ...] = ()

    @property
    def usual_map(self) -> str:
        """The kind of forward map where a run names none."""
        return "rounds"

    @property
    def has_solver(self) -> bool:
        """Say whether there is more than a table of runs that somebody made."""
        return True

    @property
    def learned_in_box(self) -> bool:
        """Say whether a part of the problem was learned inside the box of theta only."""
        return False

    @property
    def in_time(self) -> bool:
        """Say whether the past counts: FEM follows the problem through the times in theta."""
        rates = any(support.resists_velocity for support in self.supports)
        return rates or self.viscosity is not None or self.inertia is not None

    @property
    @abstractmethod
    def node_count(self) -> int:
        """The number of points whose displacement a forward map predicts."""

    @property
    @abstractmethod
    def fingerprint(self) -> str:
        """Short hash of all that solutions depend on, and of the order and the box of theta."""

    @abstractmethod
    def gradients(self, u: jax.Array) -> jax.Array:
        """Return ``H = du/dX`` at every point or state, (..., 3, 3), from ``u`` (n, 3) in mm."""

    @abstractmethod
    def tissue_at(self, theta: jax.Array) -> Tissue:
        """Return material data at ``theta`` (p,), stacked over elements and points, or states."""

    def read_table(self, path: Path) -> Path | Cells:
        """Return a data file, or its rows where this problem reads others than is usual."""
        return path

    # Theta: the parameters, in their box.

    @cached_property
    def space(self) -> ParameterSpace:
        """The box that theta lies in."""
        return ParameterSpace(self.parameters)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of theta, in order."""
        return self.space.names

    @property
    def load_parameters(self) -> tuple[str, ...]:
        """Entries of theta that belong to loads or move supports; the others are the body's."""
        return ()

    @property
    def centre(self) -> jax.Array:
        """Theta in the middle of its box, on each parameter's scale, shape (p,)."""
        return self.space.centre

    def theta(self, **values: float) -> jax.Array:
        """Return theta (p,) from named values in the parameters' units.

        Raises
        ------
        InputError
            Unknown, missing or out-of-range value.
        """
        return self.space.theta(values, f"scene '{self.name}'")

    def to_unit(self, theta: jax.Array) -> jax.Array:
        """Return the positions in the box of theta (..., p), 0 to 1 inside."""
        return self.space.to_unit(theta)

    def from_unit(self, position: jax.Array) -> jax.Array:
        """Return theta (..., p) from positions: the inverse of :meth:`to_unit`."""
        return self.space.from_unit(position)

    def resolve(self, theta: jax.Array) -> dict[str, jax.Array]:
        """Return every parameter and constant by name, at theta (p,)."""
        values: dict[str, Any] = dict(self.constants)
        values.update({name: theta[k] for k, name in enumerate(self.parameter_names)})
        return values

    # Owners of parameters.

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Every parameter that law, loads, supports and regions take, by name."""
        return {name: quantity for name, (quantity, _) in self._owners().items()}

    def _owners(self) -> Owners:
        """Return every parameter and its owner in words.

        Raises
        ------
        InputError
            Two owners of different kinds have a parameter of one name.
        """
        owners = {q.name: (q, f"law '{self.law.name}'") for q in self.law.quantities}
        owners |= {q.name: (q, "a region") for q in stiffness_quantities(self.regions, None)}
        add_owners(owners, "the fibres'", self.angles)
        if self.viscosity is not None:
            add_owners(owners, "the scene's", [self.viscosity])
        if self.timed and self.in_time:
            owners["time"] = Quantity("time", "s", 0.0, low_admitted=True), "a body in time"
        return owners

    @property
    def tissue_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that are of the material, wherever it is."""
        of_viscosity = () if self.viscosity is None else self.viscosity.quantities
        return (*self.law.parameters, *(quantity.name for quantity in of_viscosity))

    def _check_time(self) -> None:
        """Keep viscosity and inertia, also of a file's tables; refuse what time does not fit."""
        if not (self.in_time or self.viscosity is not None):
            return
        if self.viscosity is not None:
            viscosity_of = import_module("emulator.viscosity.series").viscosity_of  # a room
            object.__setattr__(self, "viscosity", viscosity_of(self.viscosity))
        if self.inertia is not None:
            inertia_of = import_module("emulator.viscosity.motion").inertia_of
            object.__setattr__(self, "inertia", inertia_of(self.inertia))
        if not self.law.objective:
            raise InputError(
                f"law '{self.law.name}' is of small strains; what goes through time needs another"
            )
        if self.loaded_by:
            raise InputError(
                "a mesh is unloaded without time; leave out loaded_by, or viscosity and inertia"
            )
        if self.timed and "time" in self.constants:
            raise InputError("'time' is a constant, so nothing goes on; make it a parameter, in s")

    def _check_directions(self, count: int, points: int, loads: Sequence[Load] = ()) -> None:
        """Refuse directions and angles that do not fit; keep them as frozen arrays.

        count, points : the number of elements or states, and of the points of one.
        """
        tissue = dict[str, Any](fibres=None, sheets=None)
        for kind, reader in directions_read(self.law, loads).items():
            directions = getattr(self, kind)
            if directions is None and reader is not None:
                raise InputError(f"{reader} needs {kind}")
            if directions is not None and reader is None:
                raise InputError(f"law '{self.law.name}' takes no {kind}")
            if directions is not None:
                tissue[kind] = checked_directions(directions, count, points, kind)
        fibres, sheets = tissue["fibres"], tissue["sheets"]
        if self.angles and fibres is None:
            raise InputError("fibre angles turn fibres, and it has none")
        tissue["angles"] = tuple(rotation.checked(count, points) for rotation in self.angles)
        if len(effective_angles(tissue["angles"], fibres, sheets)) < len(self.angles):
            raise InputError("sheet angles turn sheets, and its law takes none")
        if fibres is not None and sheets is not None:
            check_across(at_every_point(sheets, points), at_every_point(fibres, points))
        for name, value in tissue.items():
            object.__setattr__(self, name, value)

    def _check_parameters(self) -> None:
        """Refuse unknown, repeated or missing names, and inadmissible units or values."""
        owners = self._owners()
        names = [*(parameter.name for parameter in self.parameters), *self.constants]
        for name in names:
            if name not in owners:
                raise InputError(
                    f"parameter '{name}' is not one of law '{self.law.name}', its loads and "
                    f"supports: {', '.join(owners)}"
                )
            if names.count(name) > 1:
                raise InputError(f"parameter '{name}' is given twice")
        for name, (_, owner) in owners.items():
            if name not in names:
                raise InputError(f"{owner} needs '{name}'")
        faults = [owners[name][0].value_fault(value) for name, value in self.constants.items()]
        for parameter in self.parameters:
            quantity, owner = owners[parameter.name]
            faults.append(quantity.unit_fault(parameter.unit, owner))
            faults.append(quantity.range_fault(parameter.low, parameter.high))
        for fault in filter(None, faults):
            raise InputError(fault)
        if not self.parameters:
            raise InputError("no parameter varies, nothing to calibrate")

    def _summary_of_law(self) -> list[tuple[str, str]]:
        """Return the rows of law and theta in a summary."""
        ranges = [f"{p.name} {p.low:.4g} to {p.high:.4g} {p.unit}".strip() for p in self.parameters]
        return [("law", self.law.name), ("theta", ", ".join(ranges))]


def add_owners(owners: Owners, noun: str, parts: Iterable[Any]) -> None:
    """Add the parameters of ``parts`` of one kind, which may share them, to ``owners``.

    :class:`InputError` for a parameter whose name one of another kind has.
    """
    of_other_kinds = set(owners)
    for part in parts:
        owner = f"{noun} {type(part).__name__}"
        for quantity in part.quantities:
            if quantity.name in of_other_kinds:
                raise InputError(
                    f"{owner} and {owners[quantity.name][1]} both have a parameter "
                    f"'{quantity.name}'; call the {noun}'s by another name"
                )
            owners.setdefault(quantity.name, (quantity, owner))


def directions_read(law: Law, loads: Sequence[Load] = ()) -> dict[str, str | None]:
    """Return the first reader of ``fibres`` and of ``sheets``, in words; None without a reader."""
    readers = [f"law '{law.name}'"] if law.fibres else []
    readers += [f"load '{load.kind}'" for load in loads if load.fibres]
    return {
        "fibres": readers[0] if readers else None,
        "sheets": f"law '{law.name}'" if law.sheets else None,
    }
