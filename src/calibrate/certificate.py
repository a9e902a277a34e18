r"""Certificates: whether a posterior made with a cheap forward map agrees with FEM's.

Draws :math:`\theta_s` are pushed through FEM and reweighted by the ratio of likelihoods

.. math:: \log w_s = \log p_\text{FEM}(y \mid \theta_s) - \log p_\text{cheap}(y \mid \theta_s)

with Pareto-smoothed importance sampling (Vehtari et al. 2024). The shape :math:`\hat k` of the
ratios' tail decides whether the reweighted posterior can be trusted; the shift of the means, in
posterior standard deviations, decides whether reweighting is needed.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from arviz_stats.base import array_stats
from tqdm import tqdm

from calibrate.fem_likelihood import FEMLikelihood
from calibrate.posterior import Posterior
from emulator.errors import InputError
from emulator.fem import Simulator

Verdict = Literal["accepted", "reweight", "not certified"]

# Log weights closer together than this are equal to 0.1 %: their tail has no shape to fit.
_EQUAL_WEIGHTS = 1e-3
# If the largest weight is below this multiple of the mean weight, a heavy tail fitted to the last
# few weights does no harm: theta is bounded by its box, so the ratios are bounded too
# (docs/experiments.md, "When k-hat cries wolf").
_NO_TAIL = 2.0
# Largest R-hat at which the chains count as draws of one posterior; samplers aim at 1.008.
LARGEST_R_HAT = 1.05


_DRAWS = 200  # checked by default


@dataclass(frozen=True)
class Certificate:
    """Outcome of a check against FEM.

    verdict : ``accepted`` (use the posterior as it is), ``reweight`` (use ``mean_fem``), or
        ``not certified`` (FEM's posterior is too far away for reweighting, or the chains have not
        converged).
    reason : the verdict explained in words.
    k_hat, k_threshold : Pareto shape of the weights' tail, and the largest one allowed unless every
        weight is below twice the mean weight.
    ess : effective number of reweighted draws.
    shift : per parameter, mean under FEM less mean under the cheap map, in posterior sd.
    mean_fem : per parameter, the reweighted mean.
    draws, failed : FEM runs made, and how many did not converge.
    """

    verdict: Verdict
    reason: str
    k_hat: float
    k_threshold: float
    ess: float
    shift: dict[str, float]
    mean_fem: dict[str, float]
    draws: int
    failed: int

    def to_json(self) -> dict[str, Any]:
        """Plain JSON."""
        return asdict(self)


def pareto_threshold(draws: int) -> float:
    """Largest shape at which ``draws`` weighted draws are enough (Vehtari et al. 2024, Eq. 13)."""
    return float(min(1.0 - 1.0 / np.log10(draws), 0.7))


def judge(
    log_ratios: np.ndarray,
    draws: dict[str, np.ndarray],
    *,
    largest_shift: float = 0.25,
    largest_failure_rate: float = 0.02,
    r_hat: float = 1.0,
) -> Certificate:
    """The certificate from log likelihood ratios (s,) and their draws, (s,) of each parameter.

    Parameters
    ----------
    log_ratios : FEM less cheap; ``-inf`` where FEM failed.
    largest_shift : of a mean, in posterior sd, for the posterior to stand as it is. At 0.25 a
        90 % interval still covers 88.9 %.
    largest_failure_rate : fraction of FEM runs that may fail.
    r_hat : largest over the parameters; above :data:`LARGEST_R_HAT`, or NaN, nothing is certified.
    """
    log_ratios = np.asarray(log_ratios, dtype=float)
    fine = np.isfinite(log_ratios)
    count, failed = len(log_ratios), int((~fine).sum())
    threshold = pareto_threshold(count)
    if failed == count:
        nothing = dict.fromkeys(draws, float("nan"))
        return Certificate(
            "not certified", "no FEM run converged", np.inf, threshold, 0.0, nothing, nothing,
            count, failed,
        )  # fmt: skip
    weights, k_hat = _weights(log_ratios[fine])
    mean = {name: float(weights @ values[fine]) for name, values in draws.items()}
    shift = _shift(mean, draws)
    largest = float(np.max(np.abs(list(shift.values()))))  # NaN if one is
    verdict: Verdict = "not certified"
    # Every comparison is written so that NaN fails it.
    if not np.isfinite(r_hat):
        reason = "R-hat is not a number: too few draws, or draws that do not vary"
    elif not r_hat <= LARGEST_R_HAT:
        reason = f"the chains disagree, R-hat {r_hat:.3f}"
    elif not failed <= largest_failure_rate * count:
        reason = f"{failed} FEM runs failed"
    elif not (k_hat < threshold or weights.max() * len(weights) < _NO_TAIL):
        reason = "the weights' tail is too heavy to reweight"
    elif not np.isfinite(largest):
        reason = "the draws of a parameter do not vary"
    elif largest > largest_shift:
        verdict, reason = "reweight", f"a mean moves by {largest:.2f} posterior sd"
    else:
        verdict, reason = "accepted", f"no mean moves by more than {largest_shift} posterior sd"
    ess = float(1.0 / np.sum(weights**2))
    return Certificate(verdict, reason, k_hat, threshold, ess, shift, mean, count, failed)


def _weights(log_ratios: np.ndarray) -> tuple[np.ndarray, float]:
    """Smoothed weights (s,) that sum to 1, and the Pareto shape of their tail."""
    log_ratios = log_ratios - log_ratios.max()
    if np.ptp(log_ratios) < _EQUAL_WEIGHTS:
        return np.full(log_ratios.shape, 1.0 / len(log_ratios)), 0.0
    # ArviZ takes log likelihoods and negates them (docs/experiments.md, "A sign").
    log_weights, k_hat = array_stats.psislw(-log_ratios)
    weights = np.exp(np.asarray(log_weights) - np.max(log_weights))
    return weights / weights.sum(), float(k_hat)


def _shift(mean: dict[str, float], draws: dict[str, np.ndarray]) -> dict[str, float]:
    """Reweighted less plain mean, in sd of the draws; NaN where the draws do not vary."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return {
            name: float(np.float64(mean[name] - values.mean()) / values.std(ddof=1))
            for name, values in draws.items()
        }


def certify(
    posterior: Posterior, simulator: Simulator, *, draws: int | None = None, progress: bool = False
) -> Certificate:
    """Check ``posterior`` against FEM at ``draws`` of its draws, evenly spaced along the chains.

    By default at 200 of them, or at all where there are fewer. Each FEM solve starts from the cheap
    map's own prediction.

    Raises
    ------
    InputError
        The simulator is for another scene, or too few draws are asked for.
    """
    likelihood = FEMLikelihood(posterior.model, simulator)
    everything = posterior.draws()
    available = len(next(iter(everything.values())))
    draws = min(_DRAWS, available) if draws is None else draws
    if not 25 <= draws <= available:
        raise InputError(f"certify: {draws} draws asked for; give 25 to {available}")
    rows = np.linspace(0, available - 1, draws).astype(int)
    chosen = {name: values[rows] for name, values in everything.items()}
    log_ratios = np.full(draws, -np.inf)
    for s in tqdm(range(draws), "FEM check", disable=not progress, unit="run"):
        draw = {name: values[s] for name, values in chosen.items()}
        found = likelihood(draw, posterior.data)
        log_ratios[s] = found.fem - found.cheap
    # NumPy's maximum is NaN if any value is; Python's depends on their order.
    worst = float(np.max([row["r_hat"] for row in posterior.summary().values()]))
    return judge(log_ratios, chosen, r_hat=worst)
