"""Rows of a campaign in memory."""

from __future__ import annotations

from typing import Any

from emulator.fem.campaign.row import Row
from emulator.fem.campaign.starts import Field


class MemoryRows:
    """Rows by the number of their theta. ``thetas`` : of the whole design, (c, p)."""

    def __init__(self, thetas: Any) -> None:
        self.thetas = thetas
        self._rows: dict[int, Row] = {}
        self._fields: dict[int, Field] = {}

    def write(self, row: Row) -> None:
        """Keep a row."""
        self._rows[row.number] = row
        if row.converged:
            self._fields[row.number] = Field(row.solution.displacement, row.sensitivities)

    def know(self, number: int, displacement: Any) -> None:
        """Keep a solution (n, 3) mm that was there before, to start others from."""
        self._fields[number] = Field(displacement, None)

    def converged(self) -> list[int]:
        """Numbers of the rows that did, in the order they were solved."""
        return list(self._fields)

    def field(self, number: int) -> Field:
        """The solution of a row."""
        return self._fields[number]

    def in_order(self) -> list[Row]:
        """All rows, in the order of the design."""
        return [self._rows[number] for number in sorted(self._rows)]
