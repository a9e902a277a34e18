"""Parameters of laws and loads: name, unit and admissible values."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Quantity:
    """A parameter of a law or a load.

    Parameters
    ----------
    name : its name in scenes.
    unit : of its values; empty when dimensionless.
    low, high : values lie between these, both excluded.
    hint : added to the message that refuses a wrong unit.
    low_admitted : whether a value may be ``low`` itself.
    """

    name: str
    unit: str = ""
    low: float = 0.0
    high: float = math.inf
    hint: str = ""
    low_admitted: bool = False

    def unit_fault(self, unit: str, owner: str) -> str | None:
        """Message if ``owner`` cannot take a value in ``unit``, else ``None``."""
        if unit == self.unit:
            return None
        found = f"in {unit}" if unit else "given no unit"
        expected = self.unit or "it without a unit"
        hint = f" ({self.hint})" if self.hint else ""
        return f"parameter '{self.name}' is {found}; {owner} takes {expected}{hint}"

    def range_fault(self, low: float, high: float) -> str | None:
        """Message if the range from ``low`` to ``high`` is not admissible, else ``None``."""
        if not self._high_enough(low):
            least = "not go below" if self.low_admitted else "stay above"
            return f"{self._with_unit('ranges down to', low)}; it must {least} {self.low:g}"
        if not high < self.high:
            return f"{self._with_unit('ranges up to', high)}; it must stay below {self.high:g}"
        return None

    def value_fault(self, value: float) -> str | None:
        """Message if ``value`` is not admissible, else ``None``."""
        if not math.isfinite(value):
            return f"{self._with_unit('is', value)}; it must be finite"
        if not self._high_enough(value):
            least = f"{self.low:g} or more" if self.low_admitted else f"above {self.low:g}"
            return f"{self._with_unit('is', value)}; it must be {least}"
        if not value < self.high:
            return f"{self._with_unit('is', value)}; it must be below {self.high:g}"
        return None

    def _high_enough(self, value: float) -> bool:
        return value >= self.low if self.low_admitted else value > self.low

    def _with_unit(self, verb: str, value: float) -> str:
        return f"parameter '{self.name}' {verb} {value:g} {self.unit}".rstrip()


def modulus(name: str) -> Quantity:
    """A stiffness in kPa, above 0."""
    return Quantity(name, "kPa")


def number(name: str, low: float = 0.0, high: float = math.inf) -> Quantity:
    """A dimensionless parameter between ``low`` and ``high``."""
    return Quantity(name, "", low, high)
