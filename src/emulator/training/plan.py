"""What all recipes have in common: options, checks of them, and entries of an emulator's record.

A recipe is a frozen dataclass of its options with a method that trains an emulator
(:class:`~emulator.training.job.Recipe`), in a file of its own; all of them are listed in
:mod:`emulator.training.trainer`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any, ClassVar, Self

from emulator.core.errors import InputError, check_seed

Record = dict[str, Any]
"""How an emulator was trained, as plain JSON: its ``plan``, ``final_loss`` and more."""


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
    needs_slopes: ClassVar[bool] = False
    """Whether the derivatives of the FEM runs in theta are needed."""

    def __post_init__(self) -> None:
        check_seed(self.seed, "training")
        self.check()

    def check(self) -> None:
        """Raise :class:`InputError` for options that cannot work."""

    @property
    def runs(self) -> int:
        """The number of FEM runs besides the one at the centre of the box."""
        return getattr(self, "simulations", 0)

    @property
    def trains_network(self) -> bool:
        """Whether there are optimiser steps, whose number a time budget may set."""
        return "steps" in {each.name for each in fields(self)}

    def with_counts(self, **counts: int) -> Self:
        """Return the plan with the ``simulations``, ``steps`` or ``sweeps`` that were really done.

        Counts that the recipe does not have are left out.
        """
        names = {each.name for each in fields(self)}
        own_counts: dict[str, Any] = {name: n for name, n in counts.items() if name in names}
        return replace(self, **own_counts)

    def record(self, loss: float | None = None) -> Record:
        """Return the entries that every emulator's record has."""
        return {"plan": asdict(self), "final_loss": loss}

    def require_at_least(self, least: int, *names: str) -> None:
        """Raise :class:`InputError` for an option in ``names`` that is below ``least``."""
        for name in names:
            if getattr(self, name) < least:
                raise InputError(
                    f"training: {name} is {getattr(self, name)}; it must be {least} or more"
                )


def check_order(order: int) -> None:
    """Raise :class:`InputError` unless ``order`` is an order of a Taylor series."""
    if not 0 <= order <= 4:
        raise InputError(f"training: a series of order {order}; give 0 to 4")


def check_model_runs(simulations: int) -> None:
    """Raise :class:`InputError` for too few FEM runs for a discrepancy model."""
    if simulations < 1:
        raise InputError(
            f"training: {simulations} simulations; a discrepancy model needs 1 or more"
        )
