"""A noise as plain JSON: its kind and the arguments of its constructor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

from emulator.core.errors import InputError


def describe(noise: Any) -> dict[str, Any]:
    """Kind and constructor's arguments; where it was measured belongs to the observation."""
    return {"kind": noise.kind, **{n: getattr(noise, n) for n in _options(type(noise))}}


def restore[Kind](kind: type[Kind], description: Mapping[str, Any]) -> Kind:
    """The noise of this kind that :func:`describe` described.

    Raises
    ------
    InputError
        An option that the kind does not take, or one that it needs.
    """
    options = _options(kind)
    name, takes = getattr(kind, "kind", ""), ", ".join(options)
    given = {key: value for key, value in description.items() if key != "kind"}
    for key in given:
        if key not in options:
            raise InputError(f"noise {name}: '{key}' is unknown; it takes {takes}")
    for key, required in options.items():
        if required and key not in given:
            raise InputError(f"noise {name}: '{key}' is missing; it takes {takes}")
    return kind(**given)


def _options(kind: Any) -> dict[str, bool]:
    """The constructor's arguments, and whether each is required."""
    return {entry.name: entry.default is MISSING for entry in fields(kind) if entry.compare}
