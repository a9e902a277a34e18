"""The options that all recipes have, and how they are checked."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from emulator.core.errors import InputError, check_seed


@dataclass(frozen=True)
class Plan:
    """The options that all recipes have.

    Parameters
    ----------
    recipe : the name of the recipe in :data:`~emulator.training.trainer.RECIPES`.
    seed : the seed from which the weights, the theta of the FEM runs and the batches are drawn.
    campaign : the digest of the campaign whose first rows are the FEM runs; empty where training
        makes them.
    """

    recipe: str = ""
    seed: int = 0
    campaign: str = ""

    def __post_init__(self) -> None:
        check_seed(self.seed, "training")

    @property
    def runs(self) -> int:
        """The number of FEM runs besides the one at the centre of the box; none with sweeps."""
        return 0 if getattr(self, "sweeps", 0) else getattr(self, "simulations", 0)

    @property
    def trains_network(self) -> bool:
        """Whether there are optimiser steps, whose number a time budget may set."""
        return hasattr(self, "steps")

    def record(self, loss: float | None = None) -> dict[str, Any]:
        """Return the entries that every emulator's record has."""
        return {"plan": asdict(self), "final_loss": loss}

    def require_at_least(self, least: int, *names: str) -> None:
        """Raise :class:`InputError` for an option in ``names`` that is below ``least``."""
        for name in names:
            if getattr(self, name) < least:
                raise InputError(
                    f"training: {name} is {getattr(self, name)}; it must be {least} or more"
                )


def check_runs(simulations: int, needed_by: str = "a discrepancy model needs") -> None:
    """Raise :class:`InputError` where no FEM run is to be made besides the centre's."""
    if simulations < 1:
        raise InputError(f"training: {simulations} simulations; {needed_by} 1 or more")


def check_order(order: int) -> None:
    """Raise :class:`InputError` unless ``order`` is an order of a Taylor series."""
    if not 0 <= order <= 4:
        raise InputError(f"training: a series of order {order}; give 0 to 4")


def check_rate(learning_rate: float) -> None:
    """Raise :class:`InputError` unless the learning rate is positive and finite."""
    if not 0.0 < learning_rate < math.inf:
        raise InputError(
            f"training: learning_rate is {learning_rate}; it must be positive and finite"
        )
