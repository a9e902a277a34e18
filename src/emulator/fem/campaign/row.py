"""One solve of a campaign: what is asked, and what comes back."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from emulator.fem.solution import Solution


class Task(NamedTuple):
    """One solve.

    number : of the theta in its design. theta : (p,).
    starts : displacements (n, 3) mm to choose a start from; none for rest.
    """

    number: int
    theta: Any
    starts: tuple[Any, ...] = ()


class Row(NamedTuple):
    """Result of one solve.

    number : of the theta in its design. theta : (p,).
    energy : mN mm; NaN unless requested and converged.
    sensitivities : (p, n, 3), du/dtheta in mm per unit of each parameter, NaN where not converged;
        None unless requested.
    seconds : wall time.
    """

    number: int
    theta: Any
    solution: Solution
    energy: Any
    sensitivities: Any
    seconds: float

    @property
    def converged(self) -> bool:
        """Whether the solve did."""
        return bool(self.solution.converged)

    def as_numpy(self) -> Row:
        """The row with NumPy arrays, to send and to store."""
        return jax.tree.map(np.asarray, self)._replace(number=self.number, seconds=self.seconds)
