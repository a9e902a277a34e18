r"""Whether data could have come from the model, by data simulated from draws of the posterior.

Distances of simulated and measured data from a prediction say how much of the one is as far off as
the other: posterior predictive p-values :math:`P(T(y^\text{rep}) \ge T(y))` (Gelman, Meng and Stern
1996) of the data as a whole, :math:`T_1`, and of its worst datum, :math:`T_2`. From the replicates
that a posterior keeps, with mean :math:`m_j` and sd :math:`s_j` of each datum,

.. math:: T_1(y) = \sum_j (y_j - m_j)^2 / s_j^2, \qquad T_2(y) = \max_j |y_j - m_j| / s_j

This costs no evaluation and trusts the forward map; a certificate's check
(:mod:`calibrate.certificate.estimates`) trusts FEM, and knows theta.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import compress

import numpy as np
import xarray as xr

SMALLEST_P = 0.005
OUTLYING = 4.0  # sds, beyond which 0.6 % of sets of 100 Gaussian data have a datum
_FEWEST = 200  # replicates from which such a small p can be estimated


@dataclass(frozen=True)
class Misfit:
    """Discrepancies of one observation.

    p, p_worst : the posterior predictive p of the whole (T_1) and of its worst datum (T_2).
    outlying : the data beyond 4 sd, each with its mean distance in sd, the farthest first.
    """

    p: float
    p_worst: float
    outlying: dict[str, float]

    @classmethod
    def of(
        cls, places: list[str], whole: np.ndarray, simulated: np.ndarray, distance: np.ndarray
    ) -> Misfit:
        """Return the misfit of one observation from s draws.

        places : the names of the data (n,).
        whole : whether the data simulated at each draw is as unlikely as the measured, (s,).
        simulated : the distance of simulated data from its prediction, (s, n).
        distance : the distance of measured data from its prediction, (s, n) or (1, n).
        """
        # The sd is estimated from simulated data, because some distributions give none.
        sd = np.sqrt(np.mean(simulated**2, axis=0))
        simulated, distance = simulated / sd, distance / sd
        mean = distance.mean(axis=0)
        return cls(
            float(whole.mean()),
            float(np.mean(simulated.max(axis=1) >= distance.max(axis=1))),
            {places[k]: float(mean[k]) for k in np.argsort(-mean) if mean[k] > OUTLYING},
        )


def places_of(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return names of an observation's data: ``displacement[1, 2]``, or ``volume`` for one."""
    if math.prod(shape) == 1:
        return [name]
    return [f"{name}[{', '.join(map(str, k))}]" for k in np.ndindex(shape)]


def misfits(tree: xr.DataTree) -> list[str]:
    """Return a sentence for each observation that does not fit; none without replicated data."""
    if "posterior_predictive" not in tree.children:
        return []
    replicates, observed = (tree[k].to_dataset() for k in ("posterior_predictive", "observed_data"))
    return [
        sentence
        for name in observed.data_vars
        if (sentence := _sentence(str(name), replicates[name].values, observed[name].values))
    ]


def misfit_of(name: str, replicates: np.ndarray, data: np.ndarray) -> Misfit:
    """Return the misfit of data (*shape) to its replicates (chains, draws, *shape).

    Missing data is left out.
    """
    present = np.isfinite(data).ravel()
    y = replicates.reshape(-1, data.size)[:, present]
    simulated, distance = np.abs(y - y.mean(axis=0)), np.abs(data.ravel()[present] - y.mean(axis=0))
    sums = [((x / y.std(axis=0)) ** 2).sum(axis=-1) for x in (simulated, distance)]
    places = list(compress(places_of(name, data.shape), present))
    return Misfit.of(places, sums[0] >= sums[1], simulated, distance[None])


def _sentence(name: str, replicates: np.ndarray, data: np.ndarray) -> str:
    """Return a sentence on data (*shape) that its replicates do not fit; empty if they do."""
    y = replicates.reshape(-1, data.size)
    if len(y) < _FEWEST or not np.isfinite(y).all() or not (y.std(axis=0) > 0.0).all():
        return ""
    misfit = misfit_of(name, replicates, data)
    if misfit.p >= SMALLEST_P and misfit.p_worst > 0.0:
        return ""
    worst = "".join(f" ({place} is {d:.3g} sd off)" for place, d in [*misfit.outlying.items()][:1])
    return (
        f"{name} does not fit the model, posterior predictive p {min(misfit.p, misfit.p_worst):.3f}"
        f"{worst}: check outlying data, registration, units, law and noise sd"
    )
