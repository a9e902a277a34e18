"""Several tests as one specimen: its states are a batch, whose program is compiled once for all."""

import numpy as np

from emulator.specimens.states import States, states


def together(tests: dict[str, dict[str, np.ndarray]]) -> States:
    """Return the states of ``tests``, each the columns (m,) by name.

    A test without a column of others has no shear there, and is free in a direction.
    """
    counts = {test: len(next(iter(columns.values()))) for test, columns in tests.items()}
    names = dict.fromkeys(name for columns in tests.values() for name in columns)

    def column(test: str, name: str) -> np.ndarray:
        none = 0.0 if name.startswith("shear") else np.nan
        return np.asarray(tests[test].get(name, np.full(counts[test], none)))

    return states(
        {name: np.concatenate([column(test, name) for test in tests]) for name in names},
        [test for test, count in counts.items() for _ in range(count)],
    )
