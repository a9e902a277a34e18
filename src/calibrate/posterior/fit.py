r"""Whether data could have come from the model, from data replicated at draws of the posterior.

With mean :math:`m_j` and sd :math:`s_j` of the replicates :math:`y^\text{rep}` of each datum,

.. math:: T_1(y) = \sum_j (y_j - m_j)^2 / s_j^2, \qquad T_2(y) = \max_j |y_j - m_j| / s_j

have posterior predictive p-values :math:`P(T(y^\text{rep}) \ge T(y))` (Gelman, Meng and Stern
1996). This check costs no evaluation and trusts the forward map; a certificate's trusts FEM.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

SMALLEST_P = 0.005
_FEWEST = 200  # replicates that such a p can be told from


def misfits(tree: xr.DataTree) -> list[str]:
    """A sentence for each observation that does not fit; none without replicated data."""
    if "posterior_predictive" not in tree.children:
        return []
    replicates, observed = (tree[k].to_dataset() for k in ("posterior_predictive", "observed_data"))
    return [
        sentence
        for name in observed.data_vars
        if (sentence := _misfit(str(name), replicates[name].values, observed[name].values))
    ]


def tail_probabilities(replicates: np.ndarray, data: np.ndarray) -> tuple[float, float]:
    """Of :math:`T_1` and :math:`T_2`: replicates (chains, draws, *shape), data (*shape)."""
    ours, theirs = _distances(replicates, data)
    p = np.mean((theirs**2).sum(axis=1) >= (ours**2).sum())
    return float(p), float(np.mean(theirs.max(axis=1) >= ours.max()))


def _distances(replicates: np.ndarray, data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of data present (n,) and replicates (draws, n) from the replicates' mean, in their sd."""
    present = np.isfinite(data.ravel())
    y = replicates.reshape(-1, data.size)[:, present]
    mean, sd = y.mean(axis=0), y.std(axis=0)
    return np.abs(data.ravel()[present] - mean) / sd, np.abs(y - mean) / sd


def _misfit(name: str, replicates: np.ndarray, data: np.ndarray) -> str:
    """About data (*shape) and replicates (chains, draws, *shape); empty where they agree."""
    y = replicates.reshape(-1, data.size)
    if len(y) < _FEWEST or not np.isfinite(y).all() or not (y.std(axis=0) > 0.0).all():
        return ""
    p, p_worst = tail_probabilities(replicates, data)
    if p >= SMALLEST_P and p_worst > 0.0:
        return ""
    ours, _ = _distances(replicates, data)
    place = np.unravel_index(np.flatnonzero(np.isfinite(data))[ours.argmax()], data.shape)
    where = f"{name}[{', '.join(map(str, place))}]" if data.size > 1 else name
    return (
        f"{name} does not fit the model, posterior predictive p {min(p, p_worst):.3f} ({where} is "
        f"{ours.max():.3g} sd off): check outlying data, registration, units, law and noise sd"
    )
