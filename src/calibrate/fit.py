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


def _misfit(name: str, replicates: np.ndarray, data: np.ndarray) -> str:
    """About data (*shape) and replicates (chains, draws, *shape); empty where they agree."""
    y = replicates.reshape(-1, data.size)
    present = np.isfinite(data.ravel())
    mean, sd = y.mean(axis=0), y.std(axis=0)
    if len(y) < _FEWEST or not np.isfinite(y).all() or not (sd > 0.0).all():
        return ""
    ours = np.abs(data.ravel() - mean)[present] / sd[present]
    theirs = np.abs(y - mean)[:, present] / sd[present]
    p = float(np.mean((theirs**2).sum(axis=1) >= (ours**2).sum()))
    p_worst = float(np.mean(theirs.max(axis=1) >= ours.max()))
    if p >= SMALLEST_P and p_worst > 0.0:
        return ""
    place = np.unravel_index(np.flatnonzero(present)[ours.argmax()], data.shape)
    where = f"{name}[{', '.join(map(str, place))}]" if data.size > 1 else name
    return (
        f"{name} does not fit the model, posterior predictive p {min(p, p_worst):.3f} ({where} is "
        f"{ours.max():.3g} sd off): check outlying data, registration, units, law and noise sd"
    )
