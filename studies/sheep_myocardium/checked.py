"""The certificate of a heart: what FEM changes of its posterior, judged by the library's limits.

FEM at draws of the posterior, which its emulator was not fitted to, weights these by the ratio of
FEM's likelihood over the emulator's. What that changes of means and standard deviations, the tail
of the weights and the chains are judged as :func:`calibrate.certify` judges (of correlations it
also asks, which takes more runs than thirty). All is in logarithms of parameters.

The mesh's error is taken off by its order (:func:`.solver.without_mesh`); what may be left of it
is three tenths of the correction, which an order of 1 or 2 in place of 1.2 would change of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import softmax
from studies.common.output import Case
from studies.sheep_myocardium.campaign import Campaign, Plan, again, campaign, further
from studies.sheep_myocardium.experiment import Heart
from studies.sheep_myocardium.inference import Found, parameters

_SHIFT, _LOG_SD = 0.25, np.log(1.2)  # the library's limits of means, in sd, and of log sds
_MESH_SHIFT, _MESH_LOG_SD = 0.5, np.log(1.25)
_FAILED, _SPREAD = 0.02, 1.5  # runs that fail; sd of the differences of log likelihoods
_LEFT = 0.3  # of the mesh's correction
_MOST = 3  # sets of tests of one posterior


def logarithms(found: Found) -> dict[str, np.ndarray]:
    """Logarithms of parameters and omega, (d,) each."""
    each = {name: np.log(found.theta(name)) for name in parameters(found.law)}
    return each | {"omega": np.log(found.draws["omega"])}


class Figure(NamedTuple):
    """A number and its Monte Carlo error."""

    value: float
    error: float

    def within(self, limit: float) -> bool | None:
        """Whether its size is below ``limit``; ``None`` if 2.4 of its errors leave that open."""
        low, high = (abs(self.value) + side * 2.4 * self.error for side in (-1.0, 1.0))
        return None if not np.isfinite(high) or low <= limit < high else high <= limit


class Judgement(NamedTuple):
    """A verdict, why, and the figures it rests on; ``shift`` of means is in sds of the draws."""

    verdict: str
    findings: list[str]
    shift: dict[str, Figure]
    change: dict[str, Figure]
    mesh_shift: dict[str, Figure]
    spread: float
    effective: float


def certificate(found: Campaign) -> Judgement:
    """FEM's at the tests, and the mesh's, by the library's limits (``docs/accuracy.md``)."""
    explored, differences = found.explored, found.likelihood_differences()
    sound = np.isfinite(differences)
    named = logarithms(explored)
    x = np.stack(list(named.values()), axis=1)[found.tested][sound]
    weights = softmax(differences[sound]) * sound.sum()
    sd = np.stack(list(named.values()), axis=1).std(axis=0)
    value, error = _jackknife(x, weights)
    p = len(named)
    shift = _figures(named, value[:p] / sd, error[:p] / sd)
    change = _figures(named, value[p:], error[p:])
    mesh_shift, mesh_change = _mesh(found)
    spread = float(differences[sound].std())
    comparisons = [
        (f"{where}{what} of {name} moves by {figure.value:.2f}", figure.within(limit))
        for where, what, figures, limit in (
            ("", "mean", shift, _SHIFT), ("", "log sd", change, _LOG_SD),
            ("on a finer mesh the ", "mean", mesh_shift, _MESH_SHIFT),
            ("on a finer mesh the ", "log sd", mesh_change, _MESH_LOG_SD),
        )
        for name, figure in figures.items()
    ]  # fmt: skip
    faults = [
        sentence
        for sentence, right in (
            (f"FEM fails at {(~sound).sum()} of {len(sound)} draws", (~sound).mean() <= _FAILED),
            (f"the chains disagree, R-hat {explored.worst_rhat:.3f}", explored.worst_rhat <= 1.05),
            (f"few effective draws, {explored.least_ess:.0f}", explored.least_ess >= 100.0),
            (f"{explored.divergences} transitions diverged",
             explored.divergences <= max(0.002 * len(explored.positions), 1)),
            (f"FEM's likelihood differs irregularly, by {spread:.1f}", spread <= _SPREAD),
        )
        if not right
    ]  # fmt: skip
    faults += [sentence for sentence, within in comparisons if within is False]
    still_open = [sentence for sentence, within in comparisons if within is None]
    verdict = "not certified" if faults else "undecided" if still_open else "accepted"
    findings = [*faults, *still_open] or [
        f"no mean moves by more than {max(abs(f.value) for f in shift.values()):.2f} posterior sd"
    ]
    effective = float(weights.sum() ** 2 / (weights**2).sum())
    return Judgement(verdict, findings, shift, change, mesh_shift, spread, effective)


def _jackknife(x: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What weights (s,) change of means and log sds of x (s, p), (2 p,), with standard errors."""

    def moments(x: np.ndarray, w: np.ndarray) -> np.ndarray:
        mean = w @ x / w.sum()
        return np.concatenate([mean, 0.5 * np.log(w @ (x - mean) ** 2 / w.sum())])

    rows = np.arange(len(x))
    others = [rows[rows != k] for k in rows]
    every = np.stack([moments(x[k], weights[k]) - moments(x[k], np.ones(len(k))) for k in others])
    error = np.sqrt((len(x) - 1) * every.var(axis=0))
    return moments(x, weights) - moments(x, np.ones(len(x))), error


def decided(heart: Heart, plan: Plan, kept: Path | None, seed: int) -> Campaign:
    """A heart's campaign, until its certificate is accepted or it was tested often enough.

    Where too few tests leave the verdict open there are more of the same posterior; where these
    leave it open too, or say that the map is wrong, they become runs of another.
    """
    found = campaign(heart, plan, kept, seed)
    for left in reversed(range(plan.again + 1)):
        given = certificate(found)
        print(
            f"{heart.name}, {found.seconds:.0f} s: {given.verdict}: {'; '.join(given.findings)}",
            flush=True,
        )
        if given.verdict == "accepted" or not left:
            break
        few = given.verdict == "undecided" and len(found.tested) < _MOST * plan.tests
        found = (further if few else again)(found, plan, kept, seed)
    return found


def _figures(
    names: dict[str, np.ndarray], value: np.ndarray, error: np.ndarray
) -> dict[str, Figure]:
    return {n: Figure(float(v), float(e)) for n, v, e in zip(names, value, error, strict=True)}


def _mesh(found: Campaign) -> tuple[dict[str, Figure], dict[str, Figure]]:
    """What may be left of the mesh's error, of means and standard deviations of logarithms.

    Draws are weighted by the ratio of the likelihoods with that error and without.
    """
    differences = found.mesh_differences()
    weights = softmax(differences) * len(differences)
    # Of weights that are not smoothed these errors are 1.3 to 2.3 times too large (Gaussians).
    root = np.sqrt(found.explored.least_ess)
    moved, spread = {}, {}
    for name, x in logarithms(found.explored).items():
        z = (x - x.mean()) / x.std()
        shift = (weights * z).mean()
        change = 0.5 * np.log((weights * (z - shift) ** 2).mean())
        error = ((weights - 1.0) * z).std() / root
        moved[name] = Figure(-_LEFT * float(shift), _LEFT * float(error))
        error = 0.5 * ((weights - 1.0) * z**2).std() / root
        spread[name] = Figure(-_LEFT * float(change), _LEFT * float(error))
    return moved, spread


def told(found: Campaign) -> Case:
    """Errors of the emulators at draws of the posterior, and what FEM changes of it."""
    errors = np.abs(found.by_map / found.by_fem - 1.0)
    given = certificate(found)
    return {
        "fem": {
            "runs_a_cube": found.runs_a_cube,
            "seconds": found.seconds,
            "error_median": float(np.nanmedian(errors)),
            "error_90": float(np.nanquantile(errors, 0.9)),
            "doubt_by_round": list(found.learned.doubt),
            "sd_of_log_likelihood_difference": float(np.nanstd(found.likelihood_differences())),
        },
        "certificate": {
            "verdict": given.verdict,
            "reason": given.findings[0],
            "findings": given.findings,
            "shift": {n: f.value for n, f in given.shift.items()},
            "mesh_shift": {n: f.value for n, f in given.mesh_shift.items()},
            "sampling": {
                "r_hat": found.explored.worst_rhat,
                "ess": found.explored.least_ess,
                "divergences": found.explored.divergences,
                "transitions": len(found.explored.positions),
            },
            "spread": given.spread,
            "effective": given.effective,
        },
    }
