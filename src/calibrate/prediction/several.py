r"""Several laws, one prediction: posteriors of the same data by different laws, mixed by weights.

No law is right, and data that end before the prediction does not choose among those that fit.
Predictions :math:`p_k(\tilde y)` of laws k are mixed,

.. math:: p(\tilde y) = \sum_k w_k\, p_k(\tilde y), \qquad w_k \ge 0, \quad \sum_k w_k = 1.

**Stacking** takes the weights that would have predicted best what was left out of the data, one
datum at a time (Yao et al. 2018; :mod:`calibrate.posterior.comparison`). It does not suppose that
one of the laws is right. **Evidence** gives each law its probability if one of them is, all alike
beforehand: :math:`w_k \propto Z_k`. With many data it takes one law, by a hair. Where the two
differ by much, the laws' own misfit decides, or few data do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import xarray as xr

from calibrate.importance.weights import normalised
from calibrate.posterior.comparison import compare
from calibrate.prediction.predict import Predicted
from emulator.core.errors import InputError

Way = Literal["stacking", "evidence", "equal"]
"""The weights of laws follow from one of these."""
_DIFFER = 0.2  # by which evidence may give a law more weight than stacking, unsaid


@dataclass(frozen=True)
class Weights:
    """Weights of laws by name, of sum 1.

    stacking : those that predict left-out data best.
    evidence : the laws' probabilities; None where a sampler did not estimate them all.
    """

    stacking: Mapping[str, float]
    evidence: Mapping[str, float] | None

    def by(self, way: Way) -> Mapping[str, float]:
        """Return the weights of one kind; :class:`InputError` for those that are not known."""
        if way == "equal":
            return dict.fromkeys(self.stacking, 1.0 / len(self.stacking))
        if way == "stacking":
            return self.stacking
        if self.evidence is None:
            raise InputError(
                "weights: not all posteriors have an evidence; take --weights stacking or equal"
            )
        return self.evidence

    @property
    def warnings(self) -> list[str]:
        """A sentence where evidence and stacking differ."""
        if self.evidence is None:
            return []
        gaps = {name: self.evidence[name] - weight for name, weight in self.stacking.items()}
        name = max(gaps, key=lambda n: gaps[n])
        if gaps[name] <= _DIFFER:
            return []
        return [
            f"stacking gives {name} {self.stacking[name]:.2f}, evidence {self.evidence[name]:.2f}: "
            "they differ where no law is right, or where few data decide"
        ]


def weights_of(trees: Mapping[str, xr.DataTree]) -> Weights:
    """Return the weights of posteriors of the same data, by name.

    :class:`InputError` for fewer than two, for different data, or without log likelihoods.
    """
    models = {model.name: model for model in compare(trees).models}
    stacking = {name: models[name].weight for name in trees}
    logs = [models[name].log_evidence for name in trees]
    if None in logs:
        return Weights(stacking, None)
    shares = normalised(np.array(logs)).tolist()
    return Weights(stacking, dict(zip(trees, shares, strict=True)))


def mixture(
    predictions: Mapping[str, Predicted], weights: Mapping[str, float], seed: int = 0
) -> Predicted:
    """Return the mixture of predictions of one observation by several laws.

    Each law gives as many draws as its weight says, none of them twice. ``draws`` of the result has
    the number of each draw's law, in the order of ``predictions``; what is of one body only (scene,
    map, theta) is that of the heaviest law.
    """
    rng, first = np.random.default_rng([seed, 6]), next(iter(predictions.values()))
    size = min(len(p.thetas) for p in predictions.values())
    edges = np.concatenate([[0.0], np.cumsum([weights[name] for name in predictions])])
    counts = np.diff(np.round(size * edges / edges[-1]).astype(int))
    rows = {
        name: rng.permutation(len(p.thetas))[:count]
        for (name, p), count in zip(predictions.items(), counts, strict=True)
    }
    heaviest = predictions[max(predictions, key=lambda name: weights[name])]
    values = {
        name: np.concatenate([p.values[name][rows[law]] for law, p in predictions.items()])
        for name in first.values
    }
    return replace(
        heaviest,
        values=values,
        thetas=heaviest.thetas[:size],
        draws={"law": np.repeat(np.arange(len(rows)), counts)},
        runs=sum(p.runs for p in predictions.values()),
        failed=sum(p.failed for p in predictions.values()),
        missed=max(p.missed for p in predictions.values()),
        warnings=[f"{law}: {w}" for law, p in predictions.items() for w in p.warnings],
    )


def table_of(weights: Weights, laws: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return a row of each posterior as plain JSON: its law, and its weights.

    laws : the law of each posterior, by its name.
    """
    return [
        {
            "posterior": name,
            "law": laws[name],
            "stacking": weight,
            "evidence": None if weights.evidence is None else weights.evidence[name],
        }
        for name, weight in weights.stacking.items()
    ]
