"""A time budget: when FEM runs and training must end."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from emulator.core.errors import InputError
from emulator.training.plan import Plan

LEAST_S = 5.0
"""Seconds below which a budget is refused at once."""
# Fractions of a budget: until when FEM runs may start, and until when the network trains, with
# something to fit afterwards (a discrepancy model, the branch by L-BFGS) and without.
_FEM_SHARE = 0.3
_NETWORK_SHARE = 0.85
_NETWORK_ALONE = 0.99


@dataclass(frozen=True)
class Budget:
    """Seconds for a training that began at ``started`` of the performance counter.

    Raises
    ------
    InputError
        Fewer than 5 seconds, in which nothing can be compiled and solved.
    """

    seconds: float
    started: float

    def __post_init__(self) -> None:
        if self.seconds < LEAST_S:
            raise InputError(
                f"a budget of {self.seconds:g} s: one FEM solution and its compilation alone take "
                f"more than {LEAST_S:g} s; give a minute or more"
            )

    def require(self, done: str) -> None:
        """:class:`InputError` where the time is over when only ``done`` is done."""
        spent = time.perf_counter() - self.started
        if spent > self.seconds:
            raise InputError(
                f"the budget of {self.seconds:g} s is over after {done}, {spent:.0f} s; give "
                f"{4.0 * spent:.0f} s or more"
            )

    def fem_deadline(self, plan: Plan) -> float:
        """When FEM runs or sweeps stop to begin; a network alone takes all FEM runs of its plan."""
        if plan.sweeps and not plan.steps:
            return self.started + _NETWORK_ALONE * self.seconds
        early = plan.discrepancy or plan.sweeps
        return self.started + _FEM_SHARE * self.seconds if early else np.inf

    def network_deadline(self, plan: Plan) -> float:
        """When the last optimiser step should end."""
        share = _NETWORK_SHARE if plan.discrepancy or plan.polish else _NETWORK_ALONE
        return self.started + share * self.seconds
