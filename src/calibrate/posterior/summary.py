"""Draws of each parameter in a few numbers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calibrate.arviz import base, stats
from calibrate.samplers import r_hat


def summary_of(
    draws: Mapping[str, np.ndarray], probability: float = 0.9
) -> dict[str, dict[str, float]]:
    """Of draws (chains, draws): mean, sd, equal-tailed interval, R-hat, bulk and tail ESS."""
    found = base.dict_to_dataset(dict(draws))
    # By default ArviZ takes the tails of its own interval, which a user may have set.
    bulk = stats.ess(found, method="bulk")
    tail = stats.ess(found, method="tail", prob=(0.05, 0.95))
    edge = 0.5 * (1.0 - probability)
    table = {}
    for name, values in draws.items():
        low, high = np.quantile(values, [edge, 1.0 - edge])
        table[name] = {
            "mean": float(values.mean()),
            "sd": float(values.std(ddof=1)),
            "low": float(low),
            "high": float(high),
            "r_hat": r_hat(values),
            "ess_bulk": float(bulk[name]),
            "ess_tail": float(tail[name]),
        }
    return table
