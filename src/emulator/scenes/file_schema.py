"""JSON Schema of scene files, for editors that complete and check TOML.

Keys, types and descriptions are those of :mod:`emulator.scenes.file_models` and of the registries
of laws, loads, supports and fibre rules.
"""

from __future__ import annotations

from typing import Any

from emulator.core.schema import json_schema
from emulator.mechanics.laws import LAWS, Law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.file_models import SceneFile


def scene_schema() -> dict[str, Any]:
    """Draft 2020-12. It admits what the reader admits, and knows neither the mesh nor its sets."""
    schema = json_schema(SceneFile)
    keys = schema["properties"]
    keys["law"] |= {
        "enum": list(LAWS),
        "x-taplo": {"docs": {"enumValues": [_takes(law) for law in LAWS.values()]}},
    }
    varied = keys["parameters"]["additionalProperties"]
    texts = _texts()
    keys["parameters"]["properties"] = {
        name: {**varied, "description": text} for name, text in texts.items()
    }
    keys["constants"]["properties"] = {
        name: {"type": "number", "description": text} for name, text in texts.items()
    }
    one_mesh = {"oneOf": [{"required": ["mesh"]}, {"required": ["bodies"]}]}
    units = [_units(law) for law in LAWS.values()]
    return {"title": "Scene file", **schema, "allOf": [one_mesh, *units]}


def _takes(law: Law) -> str:
    """Parameters of a law with their units, and the directions it needs."""
    needs = [name for name in ("fibres", "sheets") if getattr(law, name)]
    directions = f"; needs {' and '.join(needs)}" if needs else ""
    return ", ".join(map(_with_unit, law.quantities)) + directions


def _with_unit(quantity: Quantity) -> str:
    return f"{quantity.name} ({quantity.unit})" if quantity.unit else quantity.name


def _texts() -> dict[str, str]:
    """Unit and laws of every parameter that some law has, by its name."""
    takers: dict[str, dict[str, list[str]]] = {}
    for law in LAWS.values():
        for quantity in law.quantities:
            takers.setdefault(quantity.name, {}).setdefault(quantity.unit, []).append(law.name)
    return {
        name: "; ".join(f"{unit or 'dimensionless'}, of {', '.join(of)}" for unit, of in by.items())
        for name, by in takers.items()
    }


def _units(law: Law) -> dict[str, Any]:
    """Parameters of this law have its units; where it has none, none is given."""
    parameters = {}
    for quantity in law.quantities:
        unit = {"properties": {"unit": {"const": quantity.unit}}}
        parameters[quantity.name] = {**unit, "required": ["unit"]} if quantity.unit else unit
    return {
        "if": {"properties": {"law": {"const": law.name}}, "required": ["law"]},
        "then": {"properties": {"parameters": {"properties": parameters}}},
    }
