r"""Which of several models predicts the same data better, and which makes it more likely.

Leave-one-out cross-validation scores a model by what it says of each datum, having seen all others,

.. math:: \text{elpd} = \sum_i \log p(y_i \mid y_{-i})

estimated from the draws of one posterior by Pareto-smoothed importance sampling (Vehtari, Gelman
and Gabry 2017). Differences are taken datum by datum, so that their standard error is smaller than
the scores' own. It asks which model foretells another datum of this kind. The evidence

.. math:: Z = \int p(y \mid \theta)\, p(\theta)\, d\theta

asks which model, *prior included*, expected the data: halving the range of a parameter that the
data fixes doubles it. Tempered SMC and the importance sampler estimate it. Neither score says that
the better model is good: the misfit in a certificate does.

Importance sampling fails where single data move the posterior far, as in a model that does not fit.
Such a model can still lose: a datum is never less likely to the posterior that has seen it,

.. math::
    p(y_i \mid y_{-i}) = \Big( \mathrm{E}\, \frac{1}{p(y_i \mid \theta)} \Big)^{-1}
    \le \mathrm{E}\, p(y_i \mid \theta) = p(y_i \mid y),

both means over the posterior, so that the sum of the right side, estimated without weights, is a
ceiling of elpd.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from calibrate.arviz import stats
from calibrate.importance.weights import smoothed
from emulator.core.errors import InputError

SURE = 2.0  # standard errors beyond which two models differ
FEW = 4.0  # elpd below which a difference's error is not normal (Sivula et al. 2020)


@dataclass(frozen=True)
class Compared:
    """One model of a comparison.

    name : the name of the model.
    elpd, se : the expected log predictive density of left-out data, and its standard error.
    difference, difference_se : elpd less the best model's, at most 0, and its standard error.
    weight : the model's weight in [0, 1] in the mixture that predicts best (stacking).
    parameters : the effective number of parameters.
    unreliable : the number of data whose influence is too large for the estimate.
    log_evidence, log_evidence_error : log Z and its error, if the sampler estimates them.
    """

    name: str
    elpd: float
    se: float
    difference: float
    difference_se: float
    weight: float
    parameters: float
    unreliable: int
    log_evidence: float | None
    log_evidence_error: float | None

    @property
    def ceiling(self) -> float:
        """The upper bound of elpd: how well draws that have seen the data predict it."""
        return self.elpd + self.parameters


@dataclass(frozen=True)
class Comparison:
    """Models from best to worst elpd, and the number of data they were compared on."""

    models: tuple[Compared, ...]
    data: int

    @property
    def verdict(self) -> str:
        """A sentence that says what is certain about the best model."""
        best, *others = self.models
        bad = [model.name for model in others if model.unreliable and not self._beaten(model)]
        if best.unreliable:
            bad.insert(0, best.name)
        if bad:
            return (
                f"not decided: single data decide too much in {', '.join(bad)}; "
                "refit without them, or take noise with heavier tails"
            )
        second = others[0]
        if second.unreliable:  # and beaten even so
            return f"{best.name} predicts better, by at least {best.elpd - second.ceiling:.1f}"
        gap, error = -second.difference, second.difference_se
        if gap < FEW or gap < SURE * error:
            return f"not decided: {best.name} is ahead by {gap:.1f} +- {error:.1f} only"
        return f"{best.name} predicts better, by {gap:.1f} +- {error:.1f}"

    def _beaten(self, model: Compared) -> bool:
        """Return whether the best elpd exceeds ``model``'s upper bound, beyond its error."""
        gap = self.models[0].elpd - model.ceiling
        return gap >= max(FEW, SURE * model.difference_se)


def compare(trees: Mapping[str, xr.DataTree]) -> Comparison:
    """Compare posteriors of the same data, as :class:`~calibrate.posterior.Posterior` keeps them.

    :class:`InputError` for fewer than two, for different data, or without log likelihoods.
    """
    if len(trees) < 2:
        raise InputError(f"compare: {len(trees)} posterior is given; give two or more")
    for name, tree in trees.items():
        if "observed_data" not in tree:
            raise InputError(f"{name} has no observed data")
    require_same_data({name: tree["observed_data"].data_vars for name, tree in trees.items()})
    scores = {}
    with warnings.catch_warnings():
        # ArviZ's own warning of influential data; they are counted below.
        warnings.simplefilter("ignore", UserWarning)
        for name, tree in trees.items():
            scores[name] = _leave_one_out(_all_data(name, tree))
        table = stats.compare(scores, round_to="none")
    models = []
    for name, row in table.iterrows():
        score = scores[name]
        numbers = (score.elpd, score.se, row["elpd_diff"], row["dse"], row["weight"], score.p)
        elpd, se, gap, gap_se, weight, count = map(float, numbers)
        unreliable = int(np.sum(~(np.asarray(score.pareto_k) <= score.good_k)))  # NaN, too
        evidence = (trees[name].attrs.get(key) for key in ("log_evidence", "log_evidence_error"))
        known = (None if number is None else float(number) for number in evidence)
        models.append(Compared(str(name), elpd, se, gap, gap_se, weight, count, unreliable, *known))
    return Comparison(tuple(models), int(scores[next(iter(trees))].n_data_points))


def _leave_one_out(data: xr.DataTree) -> Any:
    """Return ArviZ's estimate, also where it refuses weights: a tail of equal ones stays as it is.

    A datum that no parameter moves, as of a specimen at rest, is as likely at every draw.
    """
    try:
        return stats.loo(data, pointwise=True)
    except ValueError:
        log_likelihood = data["log_likelihood"].to_dataset()["data"]
    weights, shapes = xr.zeros_like(log_likelihood), xr.zeros_like(log_likelihood[0, 0])
    for datum in range(log_likelihood.sizes["datum"]):
        result, shapes[datum] = smoothed(-log_likelihood.values[..., datum].ravel())
        weights[..., datum] = result.reshape(weights.shape[:2])
    return stats.loo(data, pointwise=True, log_weights=weights, pareto_k=shapes)


def require_same_data(data: Mapping[str, Mapping[Any, Any]]) -> None:
    """Raise :class:`InputError` where models were not given the same numbers.

    data : the data of each model by the observation's name, by the model's name.
    """
    (one, a), *others = data.items()
    for two, b in others:
        if set(a) != set(b):
            raise InputError(
                f"{one} observes {', '.join(sorted(map(str, a)))}, {two} "
                f"{', '.join(sorted(map(str, b)))}; only models of the same data can be compared"
            )
        for observed, values in a.items():
            if not np.array_equal(values, b[observed], equal_nan=True):
                raise InputError(
                    f"{one} and {two} were given different data of '{observed}'; only models of "
                    "the same data can be compared"
                )


def _all_data(name: str, tree: xr.DataTree) -> xr.DataTree:
    """Log likelihoods of all observations as one variable (chain, draw, datum)."""
    if "log_likelihood" not in tree:
        raise InputError(f"{name} has no log likelihoods; sample it with predictions")
    if tree.attrs.get("forward_error") not in (None, "null"):
        systematic = json.loads(tree.attrs.get("run", "{}")).get("systematic")
        named = f" ({', '.join(systematic)})" if systematic else ""
        raise InputError(
            f"{name} allows for systematic errors{named}, which log likelihoods of single data "
            "leave out; sample it without"
        )
    parts = [
        np.asarray(values).reshape(*values.shape[:2], -1)
        for _, values in sorted(tree["log_likelihood"].data_vars.items())
    ]
    joined = xr.Dataset({"data": (("chain", "draw", "datum"), np.concatenate(parts, axis=-1))})
    return xr.DataTree.from_dict(
        {"log_likelihood": joined, "posterior": tree["posterior"].to_dataset()}
    )
