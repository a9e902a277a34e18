r"""FEM runs at points of unconstrained coordinates, and descents of FEM's own misfit.

A map that is wrong only around a mode hides it: no draw is there, and the map elsewhere does not
lead there. FEM's own derivatives do. Each descent starts at a draw of the prior and takes
Gauss-Newton steps up FEM's log posterior,

.. math:: z' = z + H^{-1} \nabla \log\pi(z)

with :math:`\nabla \log\pi` and :math:`H` of :meth:`Predictive.curvature`. No step is longer than
the prior is wide; where FEM's log posterior decreases, the step is halved. A descent that is about
to end among the draws, where the map finds the data likely as well, gets no more runs. The runs of
the others train the correction like any run, and the pool gets points around each end that FEM
finds likely, from a Gaussian of covariance :math:`H^{-1}`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.linalg import eigh
from scipy.special import chdtri
from tqdm import tqdm

from calibrate.statistical_model.fem_likelihood import FEMLikelihood, Likelihoods
from calibrate.statistical_model.predictive import Predictive, gauss_newton_step
from emulator.surrogates.correction import Correction, fit_correction, no_correction

ROUNDS = 4  # runs of a descent
_LIKELY = 0.999  # mass of the Gaussian at the best run in which a point counts as likely
_AMONG = 0.999  # mass of the Gaussian of the draws in which a point counts as among them
_LONGEST = 1.0  # step of a descent, in sd of the prior
_SHORTEST = 0.02  # step below which a descent has converged, likewise
_MISSED = 3.0  # log likelihood by which the map may find a point less likely than _LIKELY
_MOST_ENDS = 3
_POINTS_OF_END = 256


def least_likely(best: float, dimension: int, mass: float) -> float:
    r"""Return the log density that bounds ``mass`` of a Gaussian with largest log density ``best``.

    .. math:: \log\pi > \max\log\pi - \tfrac12 \chi^2_p(\text{mass})
    """
    return best - 0.5 * float(chdtri(dimension, 1.0 - mass))


class FEMRuns(NamedTuple):
    """FEM at points z (s, p).

    fem : log likelihoods (s,), ``-inf`` where FEM did not converge.
    means : FEM's data without noise, flat (s, m); NaN where it did not converge.
    smallest_J : the smallest det F in the body, (s,).
    stable : whether the equilibrium is a minimum of the energy; ``None`` if not examined, (s,).
    slopes : derivatives (m, S, p) of the means in theta of each load state, or ``None``, (s,).
    """

    z: np.ndarray
    fem: np.ndarray
    means: np.ndarray
    smallest_J: np.ndarray
    stable: tuple[bool | None, ...]
    slopes: tuple[np.ndarray | None, ...]

    @property
    def converged(self) -> np.ndarray:
        """Whether FEM converged in each run, (s,)."""
        return np.isfinite(self.means).all(axis=1)

    @property
    def likely(self) -> np.ndarray:
        """Whether FEM finds the data as likely as near the best run, (s,)."""
        return self.fem > least_likely(self.fem.max(), self.z.shape[1], _LIKELY)

    @classmethod
    def of_map(cls, predictive: Predictive, z: np.ndarray) -> FEMRuns:
        """Return runs at points (s, p) whose solutions the map passes through: its own answers."""
        _, cheap, means = predictive.by_map(z)
        slopes = tuple(predictive.slopes(point) for point in z)
        return cls(z, cheap, means, np.full(len(z), np.nan), (None,) * len(z), slopes)

    @classmethod
    def joined(cls, parts: Iterable[FEMRuns]) -> FEMRuns:
        """Return the runs of all parts, one part after the other."""
        *arrays, stable, slopes = zip(*parts, strict=True)
        joined = map(np.concatenate, arrays)
        return cls._make([*joined, tuple(chain(*stable)), tuple(chain(*slopes))])


@dataclass
class FEMRunner:
    """Solves FEM at points, each point once.

    bar : the progress bar that counts the runs.
    """

    predictive: Predictive
    likelihood: FEMLikelihood
    bar: tqdm

    def __post_init__(self) -> None:
        self._known: dict[bytes, Likelihoods] = {}

    def __call__(self, z: np.ndarray, *, stability: int = 0, slopes: bool = False) -> FEMRuns:
        """Return FEM at points (s, p).

        stability : the number of points, the first ones, at which stability is examined.
        slopes : whether points that were not solved before get their slopes.
        """
        keys = [point.tobytes() for point in z]
        new = list(dict.fromkeys(key for key in keys if key not in self._known))
        draws, rows = self.predictive.constrain(z), [keys.index(key) for key in new]
        new_draws = [{name: values[s] for name, values in draws.items()} for s in rows]
        examined = {k for k, s in enumerate(rows) if s < stability}
        self.bar.update(len(keys) - len(new))
        if new:
            solved = self.likelihood.many(
                new_draws, self.predictive.data, stability=examined, slopes=slopes
            )
            for k, likelihoods in solved:
                self._known[new[k]] = likelihoods
                self.bar.update()
        runs = [self._known[key] for key in keys]
        missing = np.full(len(self.predictive.scales), np.nan)
        return FEMRuns(
            z,
            np.array([f.fem if np.isfinite(f.fem) else -np.inf for f in runs]),
            np.array([ravel_pytree(f.means)[0] if f.converged else missing for f in runs]),
            np.array([f.smallest_J for f in runs]),
            tuple(f.stable for f in runs),
            tuple(f.slopes for f in runs),
        )


def correction_from(
    runs: FEMRuns, predictive: Predictive, rows: int, scales: np.ndarray | None = None
) -> Correction:
    """Return the correction fitted to ``runs`` and their slopes, padded to ``rows`` points.

    scales : the size (m,) of errors of the data, where all points count alike; by default the
        noise's sd, and points that FEM finds likely count.
    """
    means, valid = predictive.means(runs.z)
    x = predictive.features(runs.z)
    usable = valid & runs.converged
    if usable.sum() < x.shape[1] + 2:
        return no_correction(rows, x.shape[1], means.shape[1])
    errors, slopes = (runs.means - means)[usable], None
    if any(runs.slopes[k] is not None for k in np.flatnonzero(usable)):
        missing = np.full((x.shape[1], means.shape[1]), np.nan)
        slopes = np.array(
            [
                missing if of_fem is None else predictive.error_slopes(runs.z[k], of_fem)
                for k, of_fem in enumerate(runs.slopes)
                if usable[k]
            ]
        )
    likely = runs.likely[usable] if scales is None else None
    scales = predictive.scales if scales is None else scales
    return fit_correction(x[usable], errors, scales, rows, likely, slopes=slopes)


@dataclass(frozen=True, eq=False)
class _Descent:
    """A descent at ``z`` (p,).

    log_posterior, curvature : FEM's at z, and minus its Hessian (p, p).
    target : the next point (p,). promise : the log posterior expected there.
    """

    z: np.ndarray
    log_posterior: float
    curvature: np.ndarray
    target: np.ndarray
    promise: float

    @classmethod
    def from_run(cls, predictive: Predictive, runs: FEMRuns, k: int) -> _Descent | None:
        """Return a descent at run ``k``; none where FEM did not converge or has no slopes."""
        slopes = runs.slopes[k]
        if slopes is None or not np.isfinite(runs.fem[k]):
            return None
        z = runs.z[k]
        prior, gradient, curvature = predictive.curvature(z, runs.means[k], slopes)
        if not (np.isfinite(gradient).all() and np.isfinite(curvature).all()):
            return None
        step, gain = gauss_newton_step(gradient, curvature, predictive.prior_sd, _LONGEST)
        log_posterior = prior + runs.fem[k]
        return cls(z, log_posterior, curvature, z + step, log_posterior + gain)


def descend(
    solver: FEMRunner,
    starts: FEMRuns,
    at_draws: FEMRuns,
    draws: np.ndarray,
    count: int,
    rng: np.random.Generator,
) -> tuple[FEMRuns, tuple[np.ndarray, ...]]:
    """Search modes of FEM's posterior away from the draws, with at most ``count`` FEM runs.

    Return the runs, and points (_, p) around each further mode of FEM.

    starts : runs with slopes, at which descents begin.
    at_draws : runs at some of the draws. draws : all draws (s, p).
    """
    predictive, sd = solver.predictive, solver.predictive.prior_sd
    best = float(np.max(predictive.by_map(at_draws.z)[0] + at_draws.fem))
    least = least_likely(best, draws.shape[1], _LIKELY)
    values, vectors = eigh(np.atleast_2d(np.cov(draws, rowvar=False)) + 1e-12 * np.eye(len(sd)))
    far = chdtri(len(sd), 1.0 - _AMONG)

    def away(points: dict[int, np.ndarray]) -> list[int]:
        """Return the keys of points (p,) not among the draws, or that the map finds unlikely."""
        if not points:
            return []
        z = np.stack(list(points.values()))
        prior, cheap, _ = predictive.by_map(z)
        white = (z - draws.mean(axis=0)) @ (vectors / np.sqrt(values))
        known = ((white**2).sum(axis=1) <= far) & (prior + cheap > least - _MISSED)
        return [key for key, inside in zip(points, known, strict=True) if not inside]

    candidates = (_Descent.from_run(predictive, starts, k) for k in range(len(starts.z)))
    descents = {k: d for k, d in enumerate(candidates) if d is not None}
    parts = [FEMRuns._make(column[:0] for column in starts)]
    remaining, width = count, max(-(-count // ROUNDS), 1)
    while remaining:
        targets = {k: d.target for k, d in descents.items()}
        lengths = {k: np.linalg.norm((d.target - d.z) / sd) for k, d in descents.items()}
        active = [k for k in away(targets) if not lengths[k] < _SHORTEST]
        chosen = sorted(active, key=lambda k: -descents[k].promise)[: min(width, remaining)]
        if not chosen:
            break
        runs = solver(np.stack([targets[k] for k in chosen]), slopes=True)
        parts.append(runs)
        remaining -= len(chosen)
        for row, k in enumerate(chosen):
            before, trial = descents[k], _Descent.from_run(predictive, runs, row)
            if trial is None or not trial.log_posterior > before.log_posterior:
                trial = replace(before, target=0.5 * (before.z + before.target))
            descents[k] = trial
    points = {k: d.z for k, d in descents.items() if d.log_posterior > least}
    ends = [descents[k] for k in away(points)]
    return FEMRuns.joined(parts), _points_around(ends, sd, rng)


def _points_around(
    ends: list[_Descent], sd: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Return points around distinct ends, the likeliest first."""
    distinct: list[_Descent] = []
    far = chdtri(len(sd), 1.0 - _AMONG)
    for end in sorted(ends, key=lambda d: -d.log_posterior):
        steps = [end.z - other.z for other in distinct]
        if all(step @ d.curvature @ step > far for step, d in zip(steps, distinct, strict=True)):
            distinct.append(end)
    clouds = []
    for end in distinct[:_MOST_ENDS]:
        values, vectors = eigh(end.curvature * sd * sd[:, None])
        root = sd[:, None] * vectors / np.sqrt(np.maximum(values, 1.0))
        clouds.append(end.z + rng.normal(size=(_POINTS_OF_END, len(sd))) @ root.T)
    return tuple(clouds)
