r"""Which measurement to add next: expected information gain from the forward map's Jacobians.

A candidate measurement :math:`y' = g'(x) + \varepsilon'` with the information F' about x
(:mod:`~calibrate.analysis.identifiability.fisher`) would tell about x, whose posterior
covariance is C now,

.. math:: \Delta = \tfrac12 \log_2 \det\left(1 + C F'\right) \text{ bits},

where the map is linear over the posterior (Lindley 1956; Chaloner and Verdinelli 1995). The gain is
averaged over draws of the posterior. No data is made and no posterior sampled. A candidate has its
noise alone: an error that it would share with what was measured is not counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.analysis.identifiability.fisher import information_at
from calibrate.measurements import Observation, Observations
from calibrate.noise import Noise
from calibrate.posterior import Posterior

_DRAWS = 32


class Candidate(NamedTuple):
    """Something that could be measured, and what one would know then.

    bits : expected information gain.
    sd : per unknown, its expected sd relative to the present one.
    """

    bits: float
    sd: dict[str, float]


def next_measurement(
    posterior: Posterior, candidates: Mapping[str, tuple[Observation, Noise]]
) -> dict[str, Candidate]:
    """Candidates by name, the most informative first.

    Parameters
    ----------
    candidates : an observation and its noise, of known sd, by name; in a body with several load
        states the name says in which, as in ``volume@diastole``.
    """
    model, draws = posterior.model, posterior.draws()
    table = np.stack([draws[name] for name in model.states.unknowns], axis=1)
    log = bool((table > 0.0).all())
    x = np.log(table) if log else table
    covariance = np.atleast_2d(np.cov(x, rowvar=False))
    rows = np.linspace(0, len(x) - 1, min(_DRAWS, len(x))).astype(int)
    found = {}
    for name, (part, noise) in candidates.items():
        told = jax.jit(information_at(model, Observations({name: part}), {name: noise}, log=log))
        gains, ratios = [], []
        for k in rows:
            information, _ = told(jnp.asarray(x[k]), None, jnp.zeros(0))
            gain, ratio = _gain(covariance, np.asarray(information))
            gains.append(gain)
            ratios.append(ratio)
        sd = dict(zip(model.states.unknowns, np.mean(ratios, axis=0).tolist(), strict=True))
        found[name] = Candidate(float(np.mean(gains)), sd)
    return dict(sorted(found.items(), key=lambda item: -item[1].bits))


def _gain(C: np.ndarray, information: np.ndarray) -> tuple[float, np.ndarray]:
    """Bits, and sd afterwards relative to now (q,)."""
    root = np.linalg.cholesky(C)
    told = np.eye(len(C)) + root.T @ information @ root
    after = root @ np.linalg.solve(told, root.T)
    bits = 0.5 * np.linalg.slogdet(told)[1] / np.log(2.0)
    return float(bits), np.sqrt(np.diagonal(after) / np.diagonal(C))
