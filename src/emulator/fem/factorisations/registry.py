"""The factorisations by name, and what a simulator may be asked for."""

from __future__ import annotations

from dataclasses import dataclass

from emulator.errors import InputError
from emulator.fem.factorisations.petsc import PETSC, PETSC_DEFINITE
from emulator.fem.factorisations.protocol import Factorisation
from emulator.fem.factorisations.suitesparse import CHOLMOD, UMFPACK

_ALL: tuple[Factorisation, ...] = (UMFPACK, CHOLMOD, PETSC, PETSC_DEFINITE)
FACTORISATIONS: dict[str, Factorisation] = {kind.name: kind for kind in _ALL}


@dataclass(frozen=True)
class Choice:
    """What a simulator factorises with.

    general : wherever ``definite`` is not asked. definite : asked first where Python sees the
    numbers and loads have potentials; None for never.
    """

    general: Factorisation
    definite: Factorisation | None = None


CHOICES = {
    "auto": Choice(UMFPACK, CHOLMOD),
    **{kind.name: Choice(kind) for kind in (UMFPACK, CHOLMOD)},
    PETSC.name: Choice(PETSC, PETSC_DEFINITE),
}


def find_choice(name: str) -> Choice:
    """The choice of that name; :class:`InputError` if unknown, or its library is missing."""
    if name not in CHOICES:
        raise InputError(f"factorisation '{name}' is unknown; known: {', '.join(CHOICES)}")
    CHOICES[name].general.check()
    return CHOICES[name]


def find_factorisation(name: str) -> Factorisation:
    """The factorisation of that name; :class:`InputError` names the known ones."""
    if name not in FACTORISATIONS:
        known = ", ".join(FACTORISATIONS)
        raise InputError(f"factorisation '{name}' is unknown; known: {known}")
    return FACTORISATIONS[name]
