"""FEM at points of unconstrained coordinates, remembered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.special import chdtri
from tqdm import tqdm

from calibrate.certificate.correction import Correction, fit, nothing
from calibrate.certificate.predictive import Predictive
from calibrate.statistical_model.fem_likelihood import FEMLikelihood, Likelihoods

_LIKELY = 0.999  # mass of the Gaussian around the likeliest run, in which a correction is judged


def least_likely(best: float, dimension: int, mass: float) -> float:
    r"""Log density that bounds ``mass`` of a Gaussian whose largest is ``best``.

    .. math:: \log\pi > \max\log\pi - \tfrac12 \chi^2_p(\text{mass})
    """
    return best - 0.5 * float(chdtri(dimension, 1.0 - mass))


class Runs(NamedTuple):
    """FEM at points z (s, p).

    fem : log likelihoods (s,), ``-inf`` where FEM did not converge.
    means : FEM's data without noise, flat (s, m); NaN where it did not converge.
    smallest_J : (s,). stable : minimum of the energy, saddle, or ``None`` for not asked, (s,).
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
        """Where FEM converged, (s,)."""
        return np.isfinite(self.means).all(axis=1)


def joined(parts: list[Runs]) -> Runs:
    """Runs one after the other."""
    return Runs(
        np.concatenate([p.z for p in parts]),
        np.concatenate([p.fem for p in parts]),
        np.concatenate([p.means for p in parts]),
        np.concatenate([p.smallest_J for p in parts]),
        tuple(s for p in parts for s in p.stable),
        tuple(s for p in parts for s in p.slopes),
    )


@dataclass
class Solver:
    """Solves FEM at points, each once; ``bar`` counts."""

    predictive: Predictive
    likelihood: FEMLikelihood
    bar: tqdm

    def __post_init__(self) -> None:
        self._known: dict[bytes, Likelihoods] = {}

    def __call__(self, z: np.ndarray, *, stability: int = 0, slopes: bool = False) -> Runs:
        """FEM at points (s, p); at the first ``stability`` of them, also whether it is stable.

        slopes : whether the slopes of points that are new are wanted.
        """
        keys = [point.tobytes() for point in z]
        new = list(dict.fromkeys(key for key in keys if key not in self._known))
        draws, rows = self.predictive.constrain(z), [keys.index(key) for key in new]
        each = [{name: values[s] for name, values in draws.items()} for s in rows]
        asked = {k for k, s in enumerate(rows) if s < stability}
        self.bar.update(len(keys) - len(new))
        for k, told in self.likelihood.many(
            each, self.predictive.data, stability=asked, slopes=slopes
        ):
            self._known[new[k]] = told
            self.bar.update()
        found = [self._known[key] for key in keys]
        missing = np.full(len(self.predictive.scales), np.nan)
        return Runs(
            z,
            np.array([f.fem if np.isfinite(f.fem) else -np.inf for f in found]),
            np.array([ravel_pytree(f.means)[0] if f.converged else missing for f in found]),
            np.array([f.smallest_J for f in found]),
            tuple(f.stable for f in found),
            tuple(f.slopes for f in found),
        )


def correction_from(runs: Runs, predictive: Predictive, rows: int) -> Correction:
    """The correction that FEM's ``runs`` say, with room for ``rows``."""
    means, valid = predictive.means(runs.z)
    x = predictive.features(runs.z)
    fine = valid & runs.converged
    if fine.sum() < x.shape[1] + 2:
        return nothing(rows, x.shape[1], means.shape[1])
    likely = runs.fem[fine] > least_likely(runs.fem.max(), predictive.dimension, _LIKELY)
    return fit(x[fine], (runs.means - means)[fine], predictive.scales, rows, likely)
