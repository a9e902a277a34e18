r"""A summary of draws in a few numbers, and sentences on the faults of a run and of its data.

Data simulated from draws of the posterior tell whether the data could have come from the model.
Distances of simulated and measured data from a prediction say how much of the one is as far off as
the other: posterior predictive p-values :math:`P(T(y^\text{rep}) \ge T(y))` (Gelman, Meng and Stern
1996) of the data as a whole, :math:`T_1`, and of its worst datum, :math:`T_2`. From the replicates
that a posterior keeps, with mean :math:`m_j` and sd :math:`s_j` of each datum,

.. math:: T_1(y) = \sum_j (y_j - m_j)^2 / s_j^2, \qquad T_2(y) = \max_j |y_j - m_j| / s_j

This costs no evaluation and trusts the forward map; a certificate's check
(:mod:`calibrate.certificate.estimates`) trusts FEM, and knows theta.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
import xarray as xr
from scipy.linalg import eigvalsh
from scipy.stats import ks_2samp

from calibrate.arviz import base, stats
from calibrate.importance.weights import LARGEST_PARETO_SHAPE
from calibrate.posterior.box import BoxEnd, in_words
from calibrate.samplers import diagnostics as limits
from calibrate.samplers.diagnostics import r_hat
from calibrate.samplers.importance import SEEN_ONCE
from calibrate.samplers.modes import MISSED_AT, MISSED_BY
from emulator.surrogates.corrected import CORRECTED
from emulator.surrogates.registry import FORWARD_MAPS

# Attributes of a run, as JSON: errors of the map at its draws, and sentences on noises by default.
MAP_ERRORS, SCALED_NOISE = "map_errors", "scaled_noise"
DATUM_NAMES = "data"  # the names of each observation's numbers, as JSON
MAP_MOVES = "map_moves"  # a number: the largest move of a mean by FEM in the map's place, in sd

TAUGHT_AT = "taught_at"  # draws by name, as JSON, at which FEM has taught the map
ROUNDS_RECORD = "rounds"  # what each round of FEM runs said of the map before it taught it, as JSON
FORESEEN = 0.1  # nats by which such a map may miss log likelihoods at draws, in root mean square
FORESEEN_ANYWHERE = 1.0  # the same wherever the data are likely
SMALLEST_P = 0.005
OUTLYING = 4.0  # sds, beyond which 0.6 % of sets of 100 Gaussian data have a datum
LARGEST_MAP_ERROR = 0.5  # noise sd by which the forward map may miss FEM's data
LARGEST_MAP_MOVE = 0.5  # posterior sd by which that may move a mean, as for a finer mesh
MAP_FIRST = "mend the map first"  # the remedy of chains on a wrong map
_FEWEST = 200  # replicates from which a small p, or a share of the prior's sd, can be estimated
_LOWEST_EFFICIENCY = 0.2
_MANY = 100.0
_MARKED = 0.5  # standard deviations from which a shift of divergences is reported
# A posterior counts as the prior if its least sd over the prior's is above the first number, and
# the largest difference of their distribution functions below the second.
_LITTLE_SD, _LITTLE_MOVED = 0.8, 0.15
_NAMED = 3  # largest number of parameters that a sentence names


Fault = tuple[str, str]
"""A statement about a fault, and a remedy; the remedy may be empty."""


@dataclass(frozen=True)
class Sampling:
    """The quality of the draws: largest R-hat, smallest effective sample sizes, divergences.

    transitions : the number of draws.
    vary : whether the draws of every parameter vary.
    """

    r_hat: float
    ess_bulk: float
    ess_tail: float
    divergences: int
    transitions: int
    vary: bool = True


def sampling_faults(s: Sampling, box: Sequence[BoxEnd] = ()) -> Iterator[Fault]:
    """Yield the faults that make draws useless for a certificate; NaN counts as a fault.

    box : the ends of ranges that end the posterior, so that no prior is to be narrowed.
    """
    if not s.vary:
        yield ("the draws of a parameter do not vary", "the sampler is stuck")
    elif not np.isfinite(s.r_hat):
        yield ("R-hat is not a number", "draw more")
    elif not s.r_hat <= limits.REFUSE_ABOVE_R_HAT:
        yield (f"the chains disagree, R-hat {s.r_hat:.3f}", "draw more, or find their modes")
    if not s.divergences <= max(limits.LARGEST_DIVERGENT * s.transitions, 1):
        yield (
            f"{s.divergences} of {s.transitions} transitions diverged",
            "the sampler cannot follow the posterior everywhere; raise target_accept"
            + ("" if box else ", or narrow a prior the data leaves open"),
        )
    if s.vary and not np.min([s.ess_bulk, s.ess_tail]) >= limits.REFUSE_BELOW_ESS:
        few = f"{s.ess_bulk:.0f} in the bulk and {s.ess_tail:.0f} in the tails"
        yield (
            f"too few effective draws, {few}",
            f"draw until both reach {limits.REFUSE_BELOW_ESS:.0f}",
        )


def map_fault(
    errors: Mapping[str, float], moves: float = np.nan, forward: str = ""
) -> Fault | None:
    """Return the fault of the forward map, if its error exceeds limits on data or on means.

    errors : the distance of the map's data from FEM's at the draws, in noise sd, by observation.
    moves : the largest move of a posterior mean that FEM is expected to make, in its sd; NaN where
        nobody asked, infinite where FEM finds a part that the posterior lacks.
    forward : the kind of the map.
    """
    sizes = {name: np.inf if np.isnan(size) else size for name, size in errors.items()}
    worst = max(sizes, key=sizes.__getitem__, default="")
    if not worst or not (sizes[worst] > LARGEST_MAP_ERROR or moves > LARGEST_MAP_MOVE):
        return None
    size, most = (
        f"{value:.2g} {unit}" if np.isfinite(value) else "an unknown amount"
        for value, unit in ((sizes[worst], "noise sd"), (moves, "sd"))
    )
    consequence = f", and FEM in its place would move a mean by {most}"
    most = consequence if moves > LARGEST_MAP_MOVE else ""
    return (
        f"the forward map misses FEM by {size} in {worst} at the draws{most}",
        closer_map(forward),
    )


def closer_map(forward: str) -> str:
    """Return the remedy where a map of this kind is too far from FEM."""
    closer = FORWARD_MAPS.get(forward, CORRECTED).closer
    return f"infer with {closer}" if closer else "check the options of FEM"


class Summary(dict[str, dict[str, float]]):
    """The numbers of each parameter by their names, printed as a table."""

    def __repr__(self) -> str:
        """Return a line for each parameter, numbers to four digits."""
        columns = list(next(iter(self.values()), {}))
        rows = [["", *columns]]
        rows += [[name, *(f"{row[c]:.4g}" for c in columns)] for name, row in self.items()]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = []
        for row in rows:
            cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
            lines.append("  ".join([row[0].ljust(widths[0]), *cells[1:]]))
        return "\n".join(lines)

    __str__ = __repr__


def summary_of(draws: Mapping[str, np.ndarray], probability: float = 0.9) -> Summary:
    """Return mean, sd, equal-tailed interval, R-hat, bulk and tail ESS of draws (chains, draws)."""
    dataset = base.dict_to_dataset(dict(draws))
    # By default ArviZ takes the tails of its own interval, which a user may have set.
    bulk = stats.ess(dataset, method="bulk")
    tail = stats.ess(dataset, method="tail", prob=(0.05, 0.95))
    edge = 0.5 * (1.0 - probability)
    table = Summary()
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


def diagnose(
    draws: Mapping[str, np.ndarray],
    statistics: Mapping[str, np.ndarray],
    summary: Mapping[str, Mapping[str, float]],
    attributes: Mapping[str, Any],
    box: Sequence[BoxEnd] = (),
) -> Iterator[str]:
    """Yield one sentence per problem, with its remedy. Yield nothing for a healthy run.

    Parameters
    ----------
    draws, statistics : the draws and the sampler's statistics by name, each (chains, draws).
    summary : the summary of each parameter, with ``r_hat``, ``ess_bulk`` and ``ess_tail``.
    attributes : the attributes of the run, e.g. ``pareto_k``.
    box : the ends of ranges that end the posterior.
    """
    yield from json.loads(attributes.get(SCALED_NOISE, "[]"))
    wrong_map = map_fault(
        json.loads(attributes.get(MAP_ERRORS, "{}")),
        attributes.get(MAP_MOVES, np.nan),
        str(attributes.get("forward", "")),
    )
    if wrong_map is not None:
        yield ": ".join(wrong_map)
    if ROUNDS_RECORD in attributes:
        yield from _round_faults(json.loads(attributes[ROUNDS_RECORD]))
    if box:
        yield ": ".join(in_words(box))
    yield from _chain_faults(draws, statistics, summary, wrong_map is None, bool(box))
    yield from _weight_faults(attributes)
    place, lighter = attributes.get(MISSED_AT), attributes.get(MISSED_BY)
    if place is not None and lighter is not None:
        times = float(np.exp(min(-lighter, np.log(_MANY))))
        mass = "many times" if times >= _MANY else f"{times:.2g} times"
        yield (
            f"no draw is at another mode of the posterior, {place}, which has {mass} the mass of "
            "all draws: use a sampler for several modes, such as smc, or a prior that leaves one "
            "of them out"
        )


def _round_faults(rounds: Sequence[Mapping[str, float]]) -> Iterator[str]:
    """Yield a sentence where the last round did not foresee FEM, or there was none."""
    if not rounds:
        yield "FEM was not foreseen by any round of runs: there was none; give more time or runs"
    for last in rounds[-1:]:
        missed, worst = last["missed"], last["worst"]
        if not (missed <= FORESEEN and worst <= FORESEEN_ANYWHERE):
            yield (
                f"FEM was not foreseen by the last round: log likelihoods were missed by "
                f"{missed:.2g} nats at draws, by {worst:.2g} at worst; allow more runs, "
                f"--most-runs {2 * int(last['runs'])}"
            )


def _chain_faults(
    draws: Mapping[str, np.ndarray],
    statistics: Mapping[str, np.ndarray],
    summary: Mapping[str, Mapping[str, float]],
    right_map: bool,
    at_an_end: bool,
) -> Iterator[str]:
    """Yield the faults of chains: divergences, chains that disagree, too few effective draws.

    right_map : whether the map is near enough to FEM; otherwise it is mended first.
    at_an_end : whether an end of a range ends the posterior.
    """
    if np.any(diverging := np.asarray(statistics.get("diverging", False), bool)):
        count, share = int(diverging.sum()), 100.0 * diverging.mean()
        clusters = [place for name, v in draws.items() if (place := _where(name, v, diverging))]
        places = " and ".join(words for _, words in sorted(clusters, reverse=True)[:_NAMED])
        yield (
            f"{count} divergent transitions of {diverging.size} ({share:.2g} %), "
            f"{f'mostly at {places}' if places else 'spread over the whole posterior'}: the "
            "posterior is too sharp or too curved there for the step size, and its part beyond may "
            "be missing. Raise target_accept towards 1, "
            + (
                "or widen the box"
                if at_an_end
                else "give more warm-up, or use a prior that leaves out what cannot be"
            )
        )
    r_hats = {name: row["r_hat"] for name, row in summary.items()}
    name = max(r_hats, key=lambda n: np.nan_to_num(r_hats[n], nan=np.inf))
    if not np.isfinite(r_hats[name]):
        yield f"R-hat of {name} is not a number: too few draws, or draws that do not vary"
    elif r_hats[name] > limits.WARN_ABOVE_R_HAT:
        cure = (
            "run longer; if it stays, there are several modes or a long ridge, for which sampler "
            "smc is made"
        )
        disagree = f"the chains disagree about {name}, R-hat {r_hats[name]:.3f}"
        yield f"{disagree}: {cure if right_map else MAP_FIRST}"
    sizes = {n: min(row["ess_bulk"], row["ess_tail"]) for n, row in summary.items()}
    name = min(sizes, key=lambda n: sizes[n])
    if not sizes[name] >= limits.ENOUGH_ESS:
        yield (
            f"{sizes[name]:.0f} effective draws of {name}, fewer than {limits.ENOUGH_ESS:.0f}: "
            f"quantiles are uncertain; {'take more draws' if right_map else MAP_FIRST}"
        )


def _weight_faults(attributes: Mapping[str, Any]) -> Iterator[str]:
    """Yield the faults of weighted draws: heavy tails, and modes that one population saw."""
    k, efficiency = attributes.get("pareto_k", 0.0), attributes.get("importance_efficiency", 1.0)
    if not (k <= LARGEST_PARETO_SHAPE and efficiency >= _LOWEST_EFFICIENCY):
        yield (
            f"the Gaussian approximation is poor, Pareto k {k:.2f} (at most "
            f"{LARGEST_PARETO_SHAPE}) and {100.0 * efficiency:.2g} % of the draws effective "
            "(at least "
            f"{100.0 * _LOWEST_EFFICIENCY:.0f} %): use a sampler, such as nuts"
        )
    if not (k := attributes.get("weights_pareto_k", 0.0)) <= LARGEST_PARETO_SHAPE:
        yield (
            f"the weights of importance sampling have a heavy tail, Pareto k {k:.2f} (at most "
            f"{LARGEST_PARETO_SHAPE}): use another sampler, such as nuts"
        )
    if (once := int(attributes.get(SEEN_ONCE, 0))) > 0:
        yield (
            f"{once} of {int(attributes['modes'])} modes were seen by one population only, so that "
            "others may be missing: sample more (--chains), or take a prior that leaves some out"
        )


def nothing_learned(tree: xr.DataTree, unknowns: Sequence[str], noise: str) -> list[str]:
    """Return a sentence if the posterior is about the prior; none with few draws of the prior.

    Each unknown's distribution, and the sd of the best known linear combination, are compared.

    noise : the noises of the data in words.
    """
    if tree["prior"].sizes["draw"] < _FEWEST:
        return []
    before, after = (
        np.stack([np.ravel(tree[group][name]) for name in unknowns])
        for group in ("prior", "posterior")
    )
    statistic = max(ks_2samp(*rows).statistic for rows in zip(before, after, strict=True))
    least = np.sqrt(eigvalsh(np.atleast_2d(np.cov(after)), np.atleast_2d(np.cov(before)))[0])
    if not (least >= _LITTLE_SD and statistic <= _LITTLE_MOVED):
        return []
    return [
        f"the data say next to nothing: what is known best keeps {100 * min(least, 1.0):.0f} % of "
        f"its prior sd. Their noise is {noise}: give your data's if it is smaller (--noise), or "
        "observe more"
    ]


def _where(name: str, values: np.ndarray, diverging: np.ndarray) -> tuple[float, str] | None:
    """Return the distance and side, as ``low mu (51.2 to 53.4)``, at which divergences gather."""
    values, inside = np.asarray(values), np.asarray(values)[diverging]
    shift = (np.median(inside) - np.median(values)) / max(float(values.std()), 1e-300)
    if abs(shift) < _MARKED:
        return None
    low, high = np.quantile(inside, [0.05, 0.95])
    return abs(shift), f"{'low' if shift < 0 else 'high'} {name} ({low:.4g} to {high:.4g})"


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


def misfits(tree: xr.DataTree) -> list[str]:
    """Return a sentence for each observation that does not fit; none without replicated data."""
    if "posterior_predictive" not in tree.children:
        return []
    sentences = []
    simulated = tree["posterior_predictive"].to_dataset()
    names = json.loads(tree.attrs.get(DATUM_NAMES, "{}"))  # which older posteriors lack
    for name, data in tree["observed_data"].data_vars.items():
        replicates = simulated[name].values
        y = replicates.reshape(-1, data.size)
        if len(y) < _FEWEST or not np.isfinite(y).all() or not (y.std(axis=0) > 0.0).all():
            continue
        numbered = [f"number {k + 1} of {name}" for k in range(data.size)]
        misfit = misfit_of(names.get(name, numbered), replicates, data.values)
        if misfit.p >= SMALLEST_P and misfit.p_worst > 0.0:
            continue
        worst = [f" ({place} is {d:.3g} sd off)" for place, d in misfit.outlying.items()]
        sentences.append(
            f"{name} does not fit the model, posterior predictive p "
            f"{min(misfit.p, misfit.p_worst):.3f}{''.join(worst[:1])}: check outlying data, "
            "registration, units, law and noise sd"
        )
    return sentences


def misfit_of(names: Sequence[str], replicates: np.ndarray, data: np.ndarray) -> Misfit:
    """Return the misfit of data (*shape) to its replicates (chains, draws, *shape).

    Missing data is left out.

    names : the names of the data.
    """
    present = np.isfinite(data).ravel()
    y = replicates.reshape(-1, data.size)[:, present]
    simulated, distance = np.abs(y - y.mean(axis=0)), np.abs(data.ravel()[present] - y.mean(axis=0))
    sums = [((x / y.std(axis=0)) ** 2).sum(axis=-1) for x in (simulated, distance)]
    return Misfit.of(list(compress(names, present)), sums[0] >= sums[1], simulated, distance[None])
