r"""From draws of the prior to where FEM itself finds the data likely.

A map that is wrong only around a mode hides it: no draw is there, and what the map says elsewhere
does not lead there. FEM's own derivatives do. Each descent takes Gauss-Newton steps up FEM's log
posterior,

.. math:: z' = z + H^{-1} \nabla \log\pi(z)

with :math:`\nabla \log\pi` and :math:`H` of :meth:`Predictive.curvature`, none longer than the
prior is wide; where FEM finds less there, half of the step is tried next. One that is about to end
among the draws, where the map finds the data likely, too, has nothing to tell and gets no more
runs. What the others find trains the correction like any run, and the pool gets points around each
end that FEM finds likely: Gaussian ones, with the covariance :math:`H^{-1}`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.special import chdtri

from calibrate.certificate.predictive import Predictive
from calibrate.certificate.runs import Runs, Solver, joined, least_likely

ROUNDS = 4  # runs of a descent
_LONGEST = 1.0  # of a step, in sd of the prior
_SHORTEST = 0.02  # of a step that leads anywhere, likewise
_AMONG = 0.999  # mass of the Gaussian around the draws that is known
_LIKELY = 0.999  # mass of the Gaussian at the best run, in which other ends count
_MISSED = 3.0  # in log likelihood, by which the map may find a point less likely than that
_MOST = 3  # ends around which the pool gets points
_AROUND = 256  # points by which an end is described


class Found(NamedTuple):
    """FEM runs of descents, and around each end that FEM finds likely, points (_, p) of z."""

    runs: Runs
    ends: tuple[np.ndarray, ...]


@dataclass
class _Descent:
    """``z`` (p,) with FEM's log posterior there, ``log``, and its curvature (p, p).

    target : (p,), the next point. promise : the log posterior that is expected there.
    """

    z: np.ndarray
    log: float
    curvature: np.ndarray
    target: np.ndarray
    promise: float


def descend(
    solver: Solver,
    starts: Runs,
    at_draws: Runs,
    draws: np.ndarray,
    count: int,
    rng: np.random.Generator,
) -> Found:
    """``count`` FEM runs of descents that begin at runs with slopes, away from ``draws`` (s, p).

    at_draws : runs at some of the draws.
    """
    predictive = solver.predictive
    prior = predictive.evaluate(at_draws.z, predictive.uncorrected).prior
    best = float(np.max(prior + at_draws.fem))
    known = _Known(predictive, draws, best)
    begun = [_begin(predictive, starts, k) for k in range(len(starts.z))]
    active = [descent for descent in begun if descent is not None]
    every: list[Runs] = []
    left, width = count, max(-(-count // ROUNDS), 1)
    while left:
        new = [d for d in known.without(active) if not _arrived(predictive, d)]
        chosen = sorted(new, key=lambda d: -d.promise)[: min(width, left)]
        if not chosen:
            break
        runs = solver(np.stack([d.target for d in chosen]), slopes=True)
        every.append(runs)
        left -= len(chosen)
        for k, descent in enumerate(chosen):
            _advance(predictive, descent, runs, k)
    likely = least_likely(best, draws.shape[1], _LIKELY)
    ends = known.without([replace(d, target=d.z) for d in active if d.log > likely])
    return Found(joined([_none_of(starts), *every]), _around_ends(ends, predictive.prior_sd, rng))


def _around_ends(
    ends: list[_Descent], sd: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Points around ends that are apart, the likeliest first."""
    apart: list[_Descent] = []
    far = chdtri(len(sd), 1.0 - _AMONG)
    for end in sorted(ends, key=lambda d: -d.log):
        steps = [end.z - other.z for other in apart]
        if all(step @ a.curvature @ step > far for step, a in zip(steps, apart, strict=True)):
            apart.append(end)
    found = []
    for end in apart[:_MOST]:
        values, vectors = eigh(end.curvature * sd * sd[:, None])
        root = sd[:, None] * vectors / np.sqrt(np.maximum(values, 1.0))
        found.append(end.z + rng.normal(size=(_AROUND, len(sd))) @ root.T)
    return tuple(found)


class _Known:
    """What the draws (s, p) tell: a Gaussian around them, where the map finds the data likely."""

    def __init__(self, predictive: Predictive, draws: np.ndarray, best: float) -> None:
        self._predictive = predictive
        self._mean = draws.mean(axis=0)
        covariance = np.atleast_2d(np.cov(draws, rowvar=False))
        values, vectors = eigh(covariance + 1e-12 * np.eye(len(covariance)))
        self._whiten = vectors / np.sqrt(values)
        self._far = chdtri(len(values), 1.0 - _AMONG)
        self._least = least_likely(best, len(values), _LIKELY) - _MISSED

    def without(self, descents: list[_Descent]) -> list[_Descent]:
        """Those whose target is not known."""
        if not descents:
            return []
        z = np.stack([d.target for d in descents])
        at = self._predictive.evaluate(z, self._predictive.uncorrected)
        near = (((z - self._mean) @ self._whiten) ** 2).sum(axis=1) <= self._far
        known = near & (at.prior + at.cheap > self._least)
        return [d for d, k in zip(descents, known, strict=True) if not k]


def _none_of(runs: Runs) -> Runs:
    return Runs(runs.z[:0], runs.fem[:0], runs.means[:0], runs.smallest_J[:0], (), ())


def _begin(predictive: Predictive, runs: Runs, k: int) -> _Descent | None:
    """The descent from run ``k``; none where FEM did not converge or has no slopes."""
    slopes = runs.slopes[k]
    if slopes is None or not np.isfinite(runs.fem[k]):
        return None
    z = runs.z[k]
    prior, gradient, curvature = predictive.curvature(z, runs.means[k], slopes)
    if not (np.isfinite(gradient).all() and np.isfinite(curvature).all()):
        return None
    step, promise = _step(gradient, curvature, predictive.prior_sd)
    log = prior + runs.fem[k]
    return _Descent(z, log, curvature, z + step, log + promise)


def _step(gradient: np.ndarray, curvature: np.ndarray, sd: np.ndarray) -> tuple[np.ndarray, float]:
    """Gauss-Newton's step (p,), none longer than allowed, and what it promises."""
    scaled = curvature * sd * sd[:, None]
    values, vectors = eigh(scaled)
    # The prior's curvature is 1; where the likelihood is not concave, only it is left.
    along = vectors.T @ (gradient * sd) / np.maximum(values, 1.0)
    length = float(np.linalg.norm(along))
    along *= min(1.0, _LONGEST / length) if length > 0.0 else 1.0
    promise = along @ (vectors.T @ (gradient * sd)) - 0.5 * along @ (values * along)
    return sd * (vectors @ along), float(promise)


def _arrived(predictive: Predictive, descent: _Descent) -> bool:
    """Whether a descent's step leads nowhere."""
    length = np.linalg.norm((descent.target - descent.z) / predictive.prior_sd)
    return bool(length < _SHORTEST)


def _advance(predictive: Predictive, descent: _Descent, runs: Runs, k: int) -> None:
    """On from run ``k`` where FEM finds more there, else half of the step."""
    there = _begin(predictive, runs, k)
    if there is not None and there.log > descent.log:
        descent.z, descent.log, descent.curvature = there.z, there.log, there.curvature
        descent.target, descent.promise = there.target, there.promise
    else:
        descent.target = 0.5 * (descent.z + descent.target)
