"""The entries of a specimen in scene files: its table, tube and grips (``docs/specimens.md``)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from emulator.core.cells import read_cells
from emulator.core.errors import InputError
from emulator.mechanics.laws import Law
from emulator.scenes.fibre_rules import Uniform
from emulator.specimens.grips import Grips, GripStresses
from emulator.specimens.specimen import Specimen, read_states
from emulator.specimens.tube import Tube
from emulator.viscosity.series import Viscosity
from emulator.viscosity.times import read_times

if TYPE_CHECKING:  # pydantic is imported when a scene file is read, not with the package
    from emulator.core.schema import Source
    from emulator.scenes.file_schema import SceneFile

# Keys of files of a mesh that those of a specimen do not have.
_OF_MESHES = (
    "mesh", "bodies", "regions", "stiffness_modes", "supports", "loads", "order", "dilatation",
    "inertia", "history", "loaded_by", "node_sets", "facet_sets",
)  # fmt: skip


def of_specimen(
    folder: Path, file: SceneFile, law: Law, source: Source
) -> tuple[type[Specimen], dict[str, Any]]:
    """Return the fields of a specimen that its table, its tube and its grips give."""
    for key in _OF_MESHES:
        if key in source.data:
            raise source.error("a specimen has none; it is held and moved by its table", (key,))
    with source.at("tube", table=("tube",)):
        if file.tube is not None and file.grips not in (None, "none"):
            raise InputError("a tube is a specimen without grips")
        tube = None if file.tube is None else Tube(**file.tube.model_dump())
    with source.at("viscosity", table=("viscosity",)):
        viscosity = None if file.viscosity is None else Viscosity(**file.viscosity.model_dump())
    with source.at("specimen"):
        assert file.specimen is not None
        table = read_cells(folder / file.specimen, unloading=viscosity is not None)
        states = read_states(table, tube, timed=viscosity is not None)
    entries: dict[str, Any] = {"states": states, "tube": tube, "table": table}
    entries["homogeneous"] = file.grips == "none"
    if viscosity is not None:
        with source.at("specimen"):
            entries |= {"viscosity": viscosity, "times": read_times(table)}
    with source.at("fibres", table=("fibres",)):
        if isinstance(file.fibres, Uniform):
            fibres, sheets, angles = file.fibres.repeated(len(states.free))
            sheets = sheets if law.sheets else None
            entries |= {"fibres": fibres, "sheets": sheets, "angles": angles}
        elif file.fibres is not None:
            raise InputError(f"rule '{file.fibres.rule}' is for a mesh; a specimen has 'uniform'")
    with source.at("grips", table=("grips",)):
        if file.grips is not None and file.grips != "none":
            of_grips = file.grips.model_dump()
            learned = of_grips.pop("learned")
            learned = GripStresses.read(folder / learned) if learned else None
            entries["grips"] = Grips(**of_grips, learned=learned)
    return Specimen, entries
