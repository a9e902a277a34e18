"""Convergence diagnostics of chains: R-hat and effective sample sizes.

R-hat and effective sample size have limits for three uses. A run goes on until it meets the first
limits, a posterior that misses the second carries a warning, and one that misses the third gets no
certificate. The first are stricter than the second, so that a run that ended by its own rule has no
warning; the third only refuses draws for which a check against FEM is meaningless.
"""

from __future__ import annotations

import numpy as np

from calibrate.arviz import array_stats

RUN_UNTIL_R_HAT = 1.008
WARN_ABOVE_R_HAT = 1.01  # Vehtari et al. (2021)
REFUSE_ABOVE_R_HAT = 1.05  # the chains are draws of different posteriors
ENOUGH_ESS = 400.0  # Vehtari et al. (2021); a run goes on until it has them
REFUSE_BELOW_ESS = 100.0
LARGEST_DIVERGENT = 0.002  # share of transitions that may diverge

_AXES = {"chain_axis": 0, "draw_axis": 1}
_FEWEST_DRAWS = 8  # draws of a single chain: two in each quarter


def r_hat(values: np.ndarray) -> float:
    """Return the rank-normalised split R-hat of ``values`` (chains, draws), Vehtari et al. (2021).

    A single chain is cut in halves first, so that its quarters are compared; NaN below 8 draws.
    """
    if values.shape[0] == 1:
        if values.shape[1] < _FEWEST_DRAWS:
            return float("nan")
        values = values[:, : values.shape[1] // 2 * 2].reshape(2, -1)
    return float(array_stats.rhat(values, **_AXES))


def least_ess(values: np.ndarray) -> float:
    """Return the effective number of draws of ``values`` (chains, draws), in bulk or tails."""
    bulk = array_stats.ess(values, method="bulk", **_AXES)
    tail = array_stats.ess(values, method="tail", prob=(0.05, 0.95), **_AXES)
    return float(np.min([bulk, tail]))


def converged(z: np.ndarray, largest_r_hat: float, smallest_ess: float) -> bool:
    """Return whether the draws ``z`` (chains, draws, p) meet both limits in every coordinate.

    R-hat and ESS are of ranks, so a monotone map of a coordinate, as from ``z`` to a parameter,
    leaves them unchanged.
    """
    for values in np.moveaxis(z, -1, 0):
        if not (r_hat(values) <= largest_r_hat and least_ess(values) >= smallest_ess):
            return False
    return True
