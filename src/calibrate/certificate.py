r"""Certificates: is a posterior made with a cheap forward map the one FEM would give.

Draws :math:`\theta_s` are pushed through FEM and reweighted by the ratio of likelihoods

.. math:: \log w_s = \log p_\text{FEM}(y \mid \theta_s) - \log p_\text{cheap}(y \mid \theta_s)

with Pareto-smoothed importance sampling (Vehtari et al. 2024). The shape :math:`\hat k` of the
ratios' tail says whether the reweighted posterior can be trusted; the shift of its means, in
posterior standard deviations, says whether reweighting is needed at all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Literal

import jax
import numpy as np
from arviz_stats.base import array_stats
from tqdm import tqdm

from calibrate.posterior import Posterior
from calibrate.statistical_model import Data, Model, NoiseValues
from emulator.errors import InputError
from emulator.fem import Simulator

Verdict = Literal["accepted", "reweight", "not certified"]

# Below this spread (in log) all weights are equal to a tenth of a percent and the tail has no
# shape to fit.
_EQUAL_WEIGHTS = 1e-3
# When even the largest weight is less than this times their mean, no tail of theirs can do harm,
# whatever shape a fit to its last few finds; the box is compact, so the ratios are bounded.
_NO_TAIL = 2.0
# Beyond this there is no one posterior to certify; for use, look for 1.01.
LARGEST_R_HAT = 1.05


@dataclass(frozen=True)
class Certificate:
    """Outcome of a check against FEM.

    verdict : ``accepted`` (use the posterior as it is), ``reweight`` (use ``mean_fem``), or
        ``not certified`` (the FEM posterior is too far away to be reached by reweighting, or the
        chains do not agree on the cheap one).
    reason : of the verdict, for people.
    k_hat, k_threshold : Pareto shape of the weights' tail, and the most it may be unless no weight
        reaches twice their mean.
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
    """The certificate from log likelihood ratios (s,) and the draws (s,) they belong to.

    Parameters
    ----------
    log_ratios : FEM less cheap; ``-inf`` where FEM failed.
    largest_shift : of a mean, in posterior sd, for the posterior to stand as it is. At 0.25 a
        90 % interval still covers 88.7 %.
    largest_failure_rate : fraction of FEM runs that may fail.
    r_hat : largest of the parameters'; above :data:`LARGEST_R_HAT` nothing is certified.
    """
    log_ratios = np.asarray(log_ratios, dtype=float)
    fine = np.isfinite(log_ratios)
    threshold = pareto_threshold(len(log_ratios))
    failed = int((~fine).sum())
    if failed == len(log_ratios):
        nothing = dict.fromkeys(draws, float("nan"))
        reason = "no FEM run converged"
        return Certificate(
            "not certified", reason, np.inf, threshold, 0.0, nothing, nothing, failed, failed
        )
    ratios = log_ratios[fine] - log_ratios[fine].max()
    if np.ptp(ratios) < _EQUAL_WEIGHTS:
        log_weights, k_hat = np.full(ratios.shape, -np.log(len(ratios))), 0.0
    else:
        # ArviZ takes log likelihoods, whose importance ratios are their inverse.
        log_weights, k_hat = array_stats.psislw(-ratios)
    weights = np.exp(np.asarray(log_weights) - np.max(log_weights))
    weights /= weights.sum()
    k_hat = float(k_hat)
    mean = {name: float(weights @ values[fine]) for name, values in draws.items()}
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = _shift(mean, draws)
    largest = max(abs(value) for value in shift.values())
    verdict: Verdict = "not certified"
    # Every comparison is written so that NaN fails it.
    if not r_hat <= LARGEST_R_HAT:
        reason = f"the chains disagree, R-hat {r_hat:.3f}"
    elif not failed <= largest_failure_rate * len(log_ratios):
        reason = f"{failed} FEM runs failed"
    elif not (k_hat < threshold or weights.max() * len(weights) < _NO_TAIL):
        reason = "the weights' tail is too heavy to reweight"
    elif not np.isfinite(largest):
        reason = "a parameter has no spread"
    elif largest > largest_shift:
        verdict, reason = "reweight", f"a mean moves by {largest:.2f} posterior sd"
    else:
        verdict, reason = "accepted", f"no mean moves by more than {largest_shift} posterior sd"
    ess = float(1.0 / np.sum(weights**2))
    return Certificate(verdict, reason, k_hat, threshold, ess, shift, mean, len(log_ratios), failed)


def _shift(mean: dict[str, float], draws: dict[str, np.ndarray]) -> dict[str, float]:
    """Reweighted less plain means in sd of the draws; NaN where they have none."""
    return {
        name: float(np.float64(mean[name] - values.mean()) / values.std(ddof=1))
        for name, values in draws.items()
    }


def certify(
    posterior: Posterior, simulator: Simulator, *, draws: int = 200, progress: bool = False
) -> Certificate:
    """Check ``posterior`` against FEM at ``draws`` of its draws, evenly spaced along the chains.

    Each FEM solve starts from the cheap map's own prediction.

    Raises
    ------
    InputError
        The simulator is for another scene, or too few draws are asked for.
    """
    model, data = posterior.model, posterior.data
    if simulator.scene.fingerprint != model.forward.scene.fingerprint:
        raise InputError("certify: the simulator's scene is not the posterior's")
    everything = posterior.draws()
    available = len(next(iter(everything.values())))
    if not 25 <= draws <= available:
        raise InputError(f"certify: {draws} draws asked for; give 25 to {available}")
    rows = np.linspace(0, available - 1, draws).astype(int)
    chosen = {name: values[rows] for name, values in everything.items()}
    start, ratio = _compiled(model)
    thetas = posterior.thetas()[rows]
    log_ratios = np.full(draws, -np.inf)
    for s in tqdm(range(draws), "FEM check", disable=not progress, unit="run"):
        # Outside jit, where the solver may use CHOLMOD.
        solution = simulator.solve(thetas[s], start(thetas[s]))
        if solution.converged:
            noise = model.noise_values({name: values[s] for name, values in chosen.items()})
            log_ratios[s] = ratio(thetas[s], solution.displacement, noise, data)
    worst = max(row["r_hat"] for row in posterior.summary().values())
    return judge(log_ratios, chosen, r_hat=worst)


@lru_cache(maxsize=4)
def _compiled(model: Model) -> tuple[Callable, Callable]:
    """The cheap map over all nodes, and the log likelihood ratio of FEM's displacement over it.

    Compiled once a model.
    """

    @jax.jit
    def ratio(
        theta: jax.Array, displacement: jax.Array, noise: NoiseValues, data: Data
    ) -> jax.Array:
        fem = model.log_likelihood(displacement[model.observe.nodes], noise, data)
        return fem - model.log_likelihood(model.forward(theta), noise, data)

    return jax.jit(model.full), ratio
