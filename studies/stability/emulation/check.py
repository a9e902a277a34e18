"""What a hard case outside the solver is: a function that tells how it ended."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple


class Ended(NamedTuple):
    """How a case ended.

    status : its name. wrong : what is wrong with an answer that claims to be right, or empty.
    note : anything else worth knowing.
    """

    status: str
    wrong: str = ""
    note: str = ""


@dataclass(frozen=True)
class Check:
    """One case; ``run`` may raise an error, which then is its end."""

    run: Callable[[], Ended]

    def examine(self) -> dict[str, Any]:
        """Run it."""
        began = time.perf_counter()
        ended = self.run()
        return {
            "time_s": time.perf_counter() - began,
            "status": ended.status,
            "silent_wrong": bool(ended.wrong),
            "note": ended.wrong or ended.note,
        }


CASES: dict[str, tuple[str, Callable[[], Check]]] = {}
"""Name -> (family, function)."""


def add(family: str, name: str, run: Callable[[], Ended]) -> None:
    """Register a case."""
    CASES[name] = (family, lambda: Check(run))
