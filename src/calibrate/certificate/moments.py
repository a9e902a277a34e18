r"""Means, standard deviations and correlations of weighted points, and what they are uncertain by.

The error of any figure is the delete-a-group jackknife's,

.. math:: e^2 = \frac{G - 1}{G} \sum_g (\hat\theta_{(g)} - \hat\theta)^2

with every G-th point in a group (Owen 2013, Section 2.7; Wolter 2007). It knows nothing of a tail
that no point has reached; Pareto :math:`\hat k` watches that.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

GROUPS = 25


def moments(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Means (p,), log standard deviations (p,) and correlations (p (p - 1) / 2,) as one vector.

    ``x`` (s, p), ``weights`` (s,) of any sum; NaN where nothing has a weight.
    """
    total = weights.sum()
    if not total > 0.0:
        p = x.shape[1]
        return np.full(2 * p + p * (p - 1) // 2, np.nan)
    share = weights / total
    mean = share @ x
    centred = x - mean
    covariance = (share[:, None] * centred).T @ centred
    sd = np.sqrt(np.diag(covariance))
    upper = np.triu_indices(len(sd), 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.concatenate([mean, np.log(sd), covariance[upper] / (sd[upper[0]] * sd[upper[1]])])


def jackknife(
    figures: Callable[[np.ndarray], np.ndarray], count: int, groups: int = GROUPS
) -> tuple[np.ndarray, np.ndarray]:
    """``figures`` of all of ``count`` points, and their errors.

    ``figures`` takes a mask (count,) of the points to use.
    """
    groups = min(groups, count)
    member = np.arange(count) % groups
    value = figures(np.ones(count, dtype=bool))
    left_out = np.array([figures(member != g) for g in range(groups)])
    return value, np.sqrt((groups - 1) / groups * ((left_out - value) ** 2).sum(axis=0))
