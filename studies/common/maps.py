"""Shipped emulators as studies take them: the map, and what was done for it."""

from typing import NamedTuple

import emulator as em


class Made(NamedTuple):
    """A forward map, the seconds of its making, and the FEM runs it took."""

    forward: em.ForwardMap
    seconds: float
    fem_runs: int


def shipped(name: str) -> Made:
    """The shipped emulator of that name, cached; the run at the centre of the box counts.

    Sweeps take no FEM run.
    """
    trained = em.load(name)
    record = trained.record
    runs = 0 if "sweeps" in record else record["plan"]["simulations"] + 1
    return Made(trained.cache(), float(record["seconds"]), runs)
