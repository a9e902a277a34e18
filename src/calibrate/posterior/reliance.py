r"""How much a posterior rests on its priors: what was learned, and what wider ones would change.

For a parameter x of a log-normal prior, with :math:`t = (\ln x - m) / s` of the logarithm m of its
median and its log sd s, the log density's derivative in :math:`\ln s` is :math:`t^2 - 1`. So the
posterior mean of :math:`\ln x` moves by :math:`\mathrm{Cov}(\ln x, t^2)` for a unit of
:math:`\ln s`, and if s doubles, to first order, by

.. math:: \Delta = \ln 2\; \mathrm{Cov}(\ln x, t^2) .
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpyro.distributions as dist

from calibrate.priors.priors import Truncated
from calibrate.statistical_model import Model

LARGEST_MOVE = 0.5
"""Posterior sd by which a prior twice as wide may move a mean before it is warned of."""


class Reliance(NamedTuple):
    """The share of one parameter that rests on its prior.

    of_prior : the posterior sd of its logarithm over the prior's.
    move : the change of the mean of its logarithm, in posterior sd, if the prior's log sd doubles.
    """

    of_prior: float
    move: float


def reliance_of(model: Model, draws: Mapping[str, np.ndarray]) -> dict[str, Reliance]:
    """Return what each unknown with a log-normal prior owes to it.

    draws : draws (s,) by the unknown's name.
    """
    owed = {}
    for name in model.states.unknowns:
        prior = model.prior[name]
        if isinstance(prior, Truncated):
            prior = prior.base_dist
        if not isinstance(prior, dist.LogNormal):
            continue
        logs, width = np.log(draws[name]), float(prior.scale)
        t = (logs - float(prior.loc)) / width
        if (sd := float(logs.std())) > 0.0:
            move = float(np.log(2.0) * np.cov(logs, t**2)[0, 1])
            owed[name] = Reliance(sd / width, move / sd)
    return owed


def rests_on_prior(owed: Mapping[str, Reliance]) -> list[str]:
    """Return a sentence for each parameter whose mean its prior decides."""
    return [
        f"{name} rests on its prior: with twice its log sd the mean would move by some "
        f"{entry.move:+.1f} sd; measure what tells more of it, or give a source for the prior"
        for name, entry in owed.items()
        if abs(entry.move) > LARGEST_MOVE
    ]
