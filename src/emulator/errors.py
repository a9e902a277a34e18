"""Errors meant for people: one line that names the thing, what was found, what would be right."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class InputError(ValueError):
    """Something the user gave cannot be used. The command line prints it and exits with code 2."""


class SolverError(RuntimeError):
    """A simulation did not converge; the message names how it failed."""


def look_up[T](registry: Mapping[str, T], name: Any, what: str) -> T:
    """The entry called ``name``; :class:`InputError` lists the known ones. ``what`` is a noun."""
    if name not in registry:
        raise InputError(f"{what} '{name}' is unknown; known: {', '.join(registry)}")
    return registry[name]


def check_seed(seed: int, what: str) -> None:
    """Raise :class:`InputError` for a seed below 0; ``what`` begins the message."""
    if seed < 0:
        raise InputError(f"{what}: seed {seed} is below 0")
