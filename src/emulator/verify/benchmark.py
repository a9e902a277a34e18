"""One line of a verification table."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Benchmark:
    """A measured value against its reference.

    tolerance : largest allowed |measured - reference|.
    source : where the reference comes from.
    """

    name: str
    measured: float
    reference: float
    tolerance: float
    source: str

    @property
    def passed(self) -> bool:
        """Whether the measured value is within its tolerance; False for NaN."""
        return abs(self.measured - self.reference) <= self.tolerance

    def to_json(self) -> dict[str, Any]:
        """Plain JSON."""
        return {**asdict(self), "passed": self.passed}
