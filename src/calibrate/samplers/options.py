"""Settings that samplers share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

from calibrate.samplers.stopping import ENOUGH_ESS, RUN_UNTIL_R_HAT
from emulator.core.errors import InputError

RANDOM, PATHFINDER = "random", "pathfinder"


@dataclass(frozen=True)
class ChainOptions:
    """Length of a run.

    warmup : adapting iterations, not kept.
    draws : kept iterations of a round; the pilot is shorter.
    chains : independent chains.
    rounds : largest number of rounds; another one begins while R-hat or ESS miss their limits.
    r_hat, ess : largest R-hat and smallest bulk and tail ESS of any parameter to stop at.
    start : of the chains: ``random``, within two units of the centre, or ``pathfinder``
        (:mod:`calibrate.samplers.pathfinder`).
    """

    warmup: int = 500
    draws: int = 1000
    chains: int = 4
    rounds: int = 8
    r_hat: float = RUN_UNTIL_R_HAT
    ess: float = ENOUGH_ESS
    start: str = RANDOM

    label: ClassVar[str] = "chains"

    @classmethod
    def sized(cls, *, warmup: int, draws: int, chains: int) -> Self:
        """Options of a run of this length, all else by default."""
        return cls(warmup=warmup, draws=draws, chains=chains)

    def __post_init__(self) -> None:
        check_counts(self, "warmup", "draws", "chains", "rounds")
        if self.start not in (RANDOM, PATHFINDER):
            raise InputError(
                f"{self.label}: start is '{self.start}'; it is {RANDOM} or {PATHFINDER}"
            )
        if not self.r_hat > 1.0:
            raise InputError(f"{self.label}: r_hat is {self.r_hat}; it must be above 1")
        if not self.ess >= 0.0:
            raise InputError(f"{self.label}: ess is {self.ess}; it must be 0 or more")


def check_counts(options: Any, *names: str) -> None:
    """:class:`InputError` unless each of these settings is 1 or more."""
    for name in names:
        if getattr(options, name) < 1:
            raise InputError(
                f"{options.label}: {name} is {getattr(options, name)}; it must be 1 or more"
            )


def check_target_accept(label: str, value: float) -> None:
    """:class:`InputError` unless an acceptance rate lies in (0, 1)."""
    if not 0.0 < value < 1.0:
        raise InputError(f"{label}: target_accept is {value}; give one in (0, 1)")
