"""How emulators of this study are judged."""

from __future__ import annotations

from typing import Any

from emulator.accuracy.comparison import case_errors, quantiles
from emulator.fem import Runs
from emulator.surrogates import Emulator

TEST_SEED = 90_210
"""Of the theta that nothing has seen."""
ERRORS = ("err_u", "err_F", "err_Pi", "err_V")


def errors_of(emulator: Emulator, known: Runs) -> dict[str, Any]:
    """Quantiles of the errors against FEM."""
    found = case_errors(emulator.cache(), known.theta, known.displacement)
    return {key: quantiles(found.fields[key]) for key in ERRORS if key in found.fields}
