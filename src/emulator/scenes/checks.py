"""Checks of a scene: each parameter has an owner, directions have readers, the body is fixed.

Messages do not name the scene: :class:`~emulator.scenes.scene.Scene` puts its name before them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.fibres import check_across, checked_directions
from emulator.mechanics.laws import Law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.loads.load import Load
from emulator.scenes.scene_data import Dilatation, SceneData
from emulator.scenes.supports.boundary_condition import check_motions
from emulator.scenes.supports.dirichlet import Prescribed
from emulator.scenes.tissue import (
    at_every_point,
    checked_angles,
    checked_regions,
    region_quantities,
)

Owners = Mapping[str, tuple[Quantity, str]]
"""Quantity of every parameter, by name, and the law, load, support or region that takes it."""


def checked_tissue(scene: SceneData) -> dict[str, Any]:
    """Return regions, fibres, sheets and angles of ``scene`` as checked, read-only arrays.

    Raises
    ------
    InputError
        Directions that nothing reads, missing ones, or arrays that do not fit the mesh.
    """
    mesh, checked = scene.mesh, dict[str, Any](regions=scene.regions, fibres=None, sheets=None)
    if scene.regions is not None:
        checked["regions"] = checked_regions(scene.regions, len(mesh.elements), scene.law)
    for kind, reader in directions_read(scene.law, scene.loads).items():
        directions = getattr(scene, kind)
        if directions is None and reader is not None:
            raise InputError(f"{reader} needs {kind}")
        if directions is not None and reader is None:
            raise InputError(f"law '{scene.law.name}' takes no {kind}")
        if directions is not None:
            checked[kind] = checked_directions(directions, mesh, kind)
    fibres, sheets = checked["fibres"], checked["sheets"]
    checked["angles"] = checked_angles(scene.angles, mesh, fibres, sheets)
    if fibres is not None and sheets is not None:
        check_across(at_every_point(sheets, mesh.order), at_every_point(fibres, mesh.order))
    return checked


def check_scene(scene: SceneData, prescribed: Prescribed) -> None:
    """Refuse parameters, supports and loads that do not fit together.

    Parameters
    ----------
    scene : a scene whose tissue is checked.
    prescribed : the displacements that its supports prescribe.

    Raises
    ------
    InputError
        One line: what is wrong, what was found, what would be right.
    """
    _check_parameters(scene, owners_of(scene))
    _check_dilatation(scene.dilatation, scene.mesh.order)
    if not scene.parameters:
        raise InputError("no parameter varies, nothing to calibrate")
    if not scene.supports:
        raise InputError("no support, the body could move freely")
    components, fixed, per_unit = prescribed
    check_motions(scene.mesh, scene.supports)
    for part in (*scene.loads, *scene.supports):
        for name in part.facet_sets:
            scene.mesh.facet_set(name)
    displacement = sum((np.abs(each) for each in per_unit.values()), np.abs(fixed))
    for load in scene.loads:
        load.check(scene.mesh, components, displacement)
    _check_image(scene.loaded_by, load_parameters(scene, prescribed))


def owners_of(scene: SceneData) -> Owners:
    """Return every parameter of ``scene`` with its owner; loads may share one, and so may supports.

    Raises
    ------
    InputError
        Two owners of different kinds have a parameter of one name, or ``loaded_by`` names a
        parameter that no load has.
    """
    owners = {q.name: (q, f"law '{scene.law.name}'") for q in scene.law.quantities}
    if scene.regions is not None:
        owners |= {q.name: (q, "a region") for q in region_quantities(scene.regions)}
    groups = (("the fibres'", scene.angles), ("load", scene.loads), ("support", scene.supports))
    for noun, parts in groups:
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
    of_loads = {quantity.name: quantity for load in scene.loads for quantity in load.quantities}
    for load, image in scene.loaded_by.items():
        if load not in of_loads:
            known = ", ".join(of_loads) or "none"
            raise InputError(f"loaded_by: '{load}' is no parameter of a load; there are {known}")
        owners.setdefault(image, (replace(of_loads[load], name=image), f"'{load}' in the image"))
    return owners


def load_parameters(scene: SceneData, prescribed: Prescribed) -> tuple[str, ...]:
    """Return the entries of theta that belong to loads or scale prescribed displacements."""
    names = {quantity.name for load in scene.loads for quantity in load.quantities}
    names |= set(prescribed.per_unit)
    return tuple(parameter.name for parameter in scene.parameters if parameter.name in names)


def directions_read(law: Law, loads: Sequence[Load]) -> dict[str, str | None]:
    """Return the first reader of ``fibres`` and of ``sheets``, in words; None without a reader."""
    readers = [f"law '{law.name}'"] if law.fibres else []
    readers += [f"load '{load.kind}'" for load in loads if load.fibres]
    return {
        "fibres": readers[0] if readers else None,
        "sheets": f"law '{law.name}'" if law.sheets else None,
    }


def _check_parameters(scene: SceneData, owners: Owners) -> None:
    """Refuse unknown, repeated or missing names, and inadmissible units or values."""
    names = [*(parameter.name for parameter in scene.parameters), *scene.constants]
    for name in names:
        if name not in owners:
            raise InputError(
                f"parameter '{name}' is not one of law '{scene.law.name}', its loads and supports: "
                f"{', '.join(owners)}"
            )
        if names.count(name) > 1:
            raise InputError(f"parameter '{name}' is given twice")
    for name, (_, owner) in owners.items():
        if name not in names:
            raise InputError(f"{owner} needs '{name}'")
    faults = [owners[name][0].value_fault(value) for name, value in scene.constants.items()]
    for parameter in scene.parameters:
        quantity, owner = owners[parameter.name]
        faults.append(quantity.unit_fault(parameter.unit, owner))
        faults.append(quantity.range_fault(parameter.low, parameter.high))
    for fault in filter(None, faults):
        raise InputError(fault)


def _check_dilatation(dilatation: str, order: int) -> None:
    """Refuse an unknown ``dilatation``, or one that elements of ``order`` do not have."""
    if dilatation not in get_args(Dilatation):
        raise InputError(
            f"dilatation '{dilatation}'; use pointwise or mean, or patch on linear tetrahedra"
        )
    if dilatation == "mean" and order == 1:
        raise InputError(
            "mean dilatation on linear tetrahedra changes nothing, they have one point each; make "
            "the mesh quadratic, or write dilatation 'patch'"
        )
    if dilatation == "patch" and order == 2:
        raise InputError(
            "patch dilatation is for linear tetrahedra; on quadratic ones write dilatation 'mean'"
        )


def _check_image(loaded_by: Mapping[str, str], load_parameters: Sequence[str]) -> None:
    """Refuse a load in theta without a value in the image, and a value for a constant load."""
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
