"""The draws of each parameter in a few numbers, and what is wrong with a run, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calibrate.arviz import base, stats
from calibrate.samplers import r_hat
from calibrate.samplers.diagnostics import ENOUGH_ESS, WARN_ABOVE_R_HAT
from calibrate.samplers.laplace import MISSED_AT, MISSED_BY


def summary_of(
    draws: Mapping[str, np.ndarray], probability: float = 0.9
) -> dict[str, dict[str, float]]:
    """Return mean, sd, equal-tailed interval, R-hat, bulk and tail ESS of draws (chains, draws)."""
    dataset = base.dict_to_dataset(dict(draws))
    # By default ArviZ takes the tails of its own interval, which a user may have set.
    bulk = stats.ess(dataset, method="bulk")
    tail = stats.ess(dataset, method="tail", prob=(0.05, 0.95))
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


_LARGEST_K = 0.7  # Vehtari et al. (2024)
_LOWEST_EFFICIENCY = 0.2
_LOWEST_ACCEPTANCE = 0.1
_MANY = 100.0
_MARKED = 0.5  # standard deviations from which a shift of divergences is reported
_NAMED = 3  # largest number of parameters that a sentence names


def diagnose(
    draws: Mapping[str, np.ndarray],
    statistics: Mapping[str, np.ndarray],
    summary: Mapping[str, Mapping[str, float]],
    attributes: Mapping[str, Any],
) -> list[str]:
    """Return a sentence for each thing that is wrong, with what to do; empty if nothing is.

    Parameters
    ----------
    draws, statistics : the draws and the sampler's statistics by name, each (chains, draws).
    summary : the summary of each parameter, with ``r_hat``, ``ess_bulk`` and ``ess_tail``.
    attributes : the attributes of the run, e.g. ``pareto_k``.
    """
    sentences = [
        _divergences(draws, statistics.get("diverging")),
        _disagreement(summary),
        _too_few(summary),
        _rejections(statistics.get("accepted")),
        _approximation(attributes.get("pareto_k"), attributes.get("importance_efficiency")),
        _missed(attributes.get(MISSED_AT), attributes.get(MISSED_BY)),
    ]
    return [sentence for sentence in sentences if sentence]


def _divergences(draws: Mapping[str, np.ndarray], diverging: np.ndarray | None) -> str:
    if diverging is None or not np.any(diverging):
        return ""
    diverging = np.asarray(diverging, bool)
    count, share = int(diverging.sum()), 100.0 * diverging.mean()
    clusters = [place for name, v in draws.items() if (place := _where(name, v, diverging))]
    places = [words for _, words in sorted(clusters, reverse=True)[:_NAMED]]
    return (
        f"{count} divergent transitions of {diverging.size} ({share:.2g} %)"
        + (f", mostly at {' and '.join(places)}" if places else ", spread over the whole posterior")
        + ": the posterior is too sharp or too curved there for the step size, and its part beyond "
        "may be missing. Raise target_accept towards 1, give more warm-up, or use a prior that "
        "leaves out what cannot be"
    )


def _where(name: str, values: np.ndarray, diverging: np.ndarray) -> tuple[float, str] | None:
    """Return the distance and side, as ``low mu (51.2 to 53.4)``, at which divergences gather."""
    values, inside = np.asarray(values), np.asarray(values)[diverging]
    shift = (np.median(inside) - np.median(values)) / max(float(values.std()), 1e-300)
    if abs(shift) < _MARKED:
        return None
    low, high = np.quantile(inside, [0.05, 0.95])
    return abs(shift), f"{'low' if shift < 0 else 'high'} {name} ({low:.4g} to {high:.4g})"


def _disagreement(summary: Mapping[str, Mapping[str, float]]) -> str:
    name = max(summary, key=lambda n: _worse(summary[n]["r_hat"]))
    worst = summary[name]["r_hat"]
    if worst <= WARN_ABOVE_R_HAT:
        return ""
    if not np.isfinite(worst):
        return f"R-hat of {name} is not a number: too few draws, or draws that do not vary"
    return (
        f"the chains disagree about {name}, R-hat {worst:.3f}: run longer; if it stays, there are "
        "several modes or a long ridge, for which sampler smc is made"
    )


def _worse(r_hat: float) -> float:
    return r_hat if np.isfinite(r_hat) else np.inf


def _too_few(summary: Mapping[str, Mapping[str, float]]) -> str:
    sizes = {n: min(row["ess_bulk"], row["ess_tail"]) for n, row in summary.items()}
    name = min(sizes, key=lambda n: sizes[n])
    if sizes[name] >= ENOUGH_ESS:
        return ""
    return (
        f"{sizes[name]:.0f} effective draws of {name}, fewer than {ENOUGH_ESS:.0f}: quantiles "
        "are uncertain; take more draws"
    )


def _rejections(accepted: np.ndarray | None) -> str:
    if accepted is None or (rate := float(np.mean(accepted))) >= _LOWEST_ACCEPTANCE:
        return ""
    return (
        f"FEM took {100.0 * rate:.2g} % of the proposals only: the forward map is far from FEM "
        "here; train it longer, or use forward map 'corrected'"
    )


def _approximation(pareto_k: float | None, efficiency: float | None) -> str:
    if pareto_k is None or efficiency is None:
        return ""
    if pareto_k <= _LARGEST_K and efficiency >= _LOWEST_EFFICIENCY:
        return ""
    return (
        f"the Gaussian approximation is poor, Pareto k {pareto_k:.2f} (at most {_LARGEST_K}) and "
        f"{100.0 * efficiency:.2g} % of the draws effective (at least "
        f"{100.0 * _LOWEST_EFFICIENCY:.0f} %): use a sampler, such as nuts"
    )


def _missed(place: str | None, lighter: float | None) -> str:
    if place is None or lighter is None:
        return ""
    times = float(np.exp(min(-lighter, np.log(_MANY))))
    mass = "many times" if times >= _MANY else f"{times:.2g} times"
    return (
        f"no draw is at another mode of the posterior, {place}, which has {mass} the mass of all "
        "draws: use a sampler for several modes, such as smc, or a prior that leaves one of them "
        "out"
    )
