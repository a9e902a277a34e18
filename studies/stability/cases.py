"""All cases by name, and how one ends."""

import time
from typing import Any

from studies.stability import emulation, solver

import emulator as em

FAMILIES = (
    "nearly incompressible",
    "corners of the boxes",
    "twice outside the boxes",
    "wide priors",
    "ventricles",
    "exponentials",
    "twists",
    "buckling",
    "follower pressure",
    "stiffness",
    "supports",
    "meshes",
    "starts",
    "theta",
    "training",
    "cached maps in float32",
    "error bars outside",
    "samplers",
)
CASES = dict(
    sorted((solver.CASES | emulation.CASES).items(), key=lambda item: FAMILIES.index(item[1][0]))
)
"""Name -> (family, function)."""


def outcome(name: str) -> dict[str, Any]:
    """Examine one case."""
    family, make = CASES[name]
    row: dict[str, Any] = {
        "name": name,
        "family": family,
        "status": "",
        "silent_wrong": False,
        "residual": None,
        "time_s": 0.0,
        "iterations": None,
        "load_reached": None,
        "stable": None,
        "note": "",
    }
    case = make()
    begin = time.perf_counter()
    try:
        return row | case.examine()
    except Exception as error:  # whatever it is, it is the outcome
        status = type(error).__name__
        return row | {
            "status": status
            if isinstance(error, (em.InputError, em.SolverError))
            else f"exception {status}",
            "time_s": time.perf_counter() - begin,
            "note": str(error).splitlines()[0][:160],
        }
