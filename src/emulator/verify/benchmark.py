"""A row of a verification table, and the measured order of convergence."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Benchmark:
    """A measured value against its reference.

    tolerance : largest allowed |measured - reference|. source : where the reference comes from.
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
        """Return the row as plain JSON."""
        return {**asdict(self), "passed": self.passed}


def order_of(coarse: float, middle: float, fine: float) -> float:
    r"""Return the order of convergence of three values, of elements half as long each time.

    It is :math:`\log_2 |s_1 - s_0| / |s_2 - s_1|`.
    """
    return float(np.log2(abs(middle - coarse) / abs(fine - middle)))
