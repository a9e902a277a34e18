"""Errors meant for people: one line that names the thing, what was found, what would be right."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from inspect import signature
from typing import Any


class InputError(ValueError):
    """Something the user gave cannot be used. The command line prints it and exits with code 2."""


class SolverError(RuntimeError):
    """A simulation did not converge; the message names how it failed."""


def closest(name: object, known: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the known name most like ``name``, or nothing.

    It is the first of which ``name`` is one of the words joined by underscores, if there is one.
    """
    known = list(known)
    close = [other for other in known if str(name) in other.split("_")]
    close = close or get_close_matches(str(name), known, 1)
    return f"; did you mean '{close[0]}'?" if close else ""


def check_known(name: object, known: Iterable[str], noun: str) -> None:
    """Raise :class:`InputError` unless ``name`` is ``known``: the one wording of an unknown name.

    name : the name that the user gave.
    known : the names there are.
    noun : the word for one of them, such as ``sampler``; it begins the message.
    """
    known = list(known)
    if name not in known:
        names = ", ".join(filter(None, known)) or "none"
        raise InputError(f"{noun} '{name}' is unknown; known: {names}{closest(name, known)}")


def check_arguments(options: Iterable[str], what: str, *functions: Callable[..., Any]) -> None:
    """Raise :class:`InputError`, about ``what``, for an option that no function takes by name."""
    parameters = [p for f in functions for p in signature(f).parameters.values()]
    known = dict.fromkeys(p.name for p in parameters if p.kind is p.KEYWORD_ONLY)
    for option in options:
        check_known(option, known, f"{what}: option")


def look_up[T](entries: Mapping[str, T], name: object, noun: str) -> T:
    """Return the entry called ``name``.

    entries : the registry, or any other mapping from names to things of one kind.
    name : the name that the user gave.
    noun : the word for one entry, such as ``sampler``; it begins the message.

    Raises :class:`InputError`: no entry is called ``name``; the message lists the known names.
    """
    check_known(name, entries, noun)
    return entries[str(name)]


def check_seed(seed: int, what: str) -> None:
    """Raise :class:`InputError` for a seed below 0; ``what`` begins the message."""
    if seed < 0:
        raise InputError(f"{what}: seed {seed} is below 0")
