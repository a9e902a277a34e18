"""Rooms: parts of these packages that the core works without.

The core imports none of their modules, except where a registry lists what a room offers
(:func:`offered`) and where a call needs one, and then on that call.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


def offered(module: str, name: str) -> tuple[Any, ...]:
    """Return the attribute ``name`` of a room's ``module``, or nothing if the room is not there."""
    try:
        return (getattr(import_module(module), name),)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the room is there, and lacks something itself
        return ()


def missing_room(error: ModuleNotFoundError) -> str | None:
    """Return the message for a room that a call needs and that is not there; None for others."""
    name = error.name or ""
    if not name.startswith(("emulator.", "calibrate.")):
        return None
    return f"this needs the room '{name}', which is not installed"
