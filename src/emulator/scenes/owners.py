"""Who takes which parameter of a scene: its law, a region, an angle, a load or a support."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from emulator.core.errors import InputError
from emulator.mechanics.laws import Law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.fibre_angles import FibreAngles
from emulator.scenes.loads.load import Load
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.regions import region_quantities
from emulator.scenes.supports.boundary_condition import BoundaryCondition

Owners = Mapping[str, tuple[Quantity, str]]
"""Quantity of every parameter by name, and who takes it, in words."""


def owners_of(
    law: Law,
    regions: np.ndarray | None,
    angles: Sequence[FibreAngles],
    loads: Sequence[Load],
    supports: Sequence[BoundaryCondition],
    loaded_by: Mapping[str, str],
) -> Owners:
    """Every parameter that these take; loads may share one, and so may supports.

    loaded_by : what holds the value that a load's parameter had when the mesh was taken.

    Raises
    ------
    InputError
        Two of different kinds have a parameter of one name; ``loaded_by`` names no load's.
    """
    owners = {q.name: (q, f"law '{law.name}'") for q in law.quantities}
    if regions is not None:
        owners |= {q.name: (q, "a region") for q in region_quantities(regions)}
    for what, parts in (("the fibres'", angles), ("load", loads), ("support", supports)):
        others = set(owners)
        for part in parts:
            owner = f"{what} {type(part).__name__}"
            for quantity in part.quantities:
                if quantity.name in others:
                    raise InputError(
                        f"{owner} and {owners[quantity.name][1]} both have a parameter "
                        f"'{quantity.name}'; call the {what}'s by another name"
                    )
                owners.setdefault(quantity.name, (quantity, owner))
    taken = {quantity.name: quantity for load in loads for quantity in load.quantities}
    for load, held_by in loaded_by.items():
        if load not in taken:
            raise InputError(
                f"loaded_by: '{load}' is no parameter of a load; there are "
                f"{', '.join(taken) or 'none'}"
            )
        owners.setdefault(held_by, (replace(taken[load], name=held_by), f"'{load}' in the image"))
    return owners


def directions_read(law: Law, loads: Sequence[Load]) -> dict[str, str | None]:
    """Who reads ``fibres`` and ``sheets``, in words; None where nobody does."""
    fibres = f"law '{law.name}'" if law.fibres else None
    for load in loads:
        if fibres is None and load.fibres:
            fibres = f"load '{load.kind}'"
    return {"fibres": fibres, "sheets": f"law '{law.name}'" if law.sheets else None}


def check_given(
    owners: Owners, law: Law, parameters: Sequence[Parameter], constants: Mapping[str, float]
) -> None:
    """Refuse parameters and constants that are not what ``owners`` take, each once.

    Raises
    ------
    InputError
        A name nobody takes, one given twice, one missing, or an inadmissible unit or value.
    """
    given = [*(parameter.name for parameter in parameters), *constants]
    for name in given:
        if name not in owners:
            raise InputError(
                f"parameter '{name}' is not one of law '{law.name}', its loads and supports: "
                f"{', '.join(owners)}"
            )
        if given.count(name) > 1:
            raise InputError(f"parameter '{name}' is given twice")
    for name, (_, owner) in owners.items():
        if name not in given:
            raise InputError(f"{owner} needs '{name}'")
    faults = [owners[name][0].value_fault(value) for name, value in constants.items()]
    for parameter in parameters:
        quantity, owner = owners[parameter.name]
        faults.append(quantity.unit_fault(parameter.unit, owner))
        faults.append(quantity.range_fault(parameter.low, parameter.high))
    for fault in filter(None, faults):
        raise InputError(fault)


def check_image(loaded_by: Mapping[str, str], load_parameters: Sequence[str]) -> None:
    """Refuse loads of theta of whose value in the image nothing is said, and loads of no theta."""
    for name in load_parameters if loaded_by else ():
        if name not in loaded_by:
            raise InputError(
                f"loaded_by says nothing of '{name}'; name the parameter or constant that holds "
                "its value in the image"
            )
    for name in loaded_by:
        if name not in load_parameters:
            raise InputError(
                f"loaded_by: '{name}' is a constant, so the mesh is loaded by it anyway; leave it "
                "out, or make it a parameter"
            )
