r"""Profile likelihoods: how well one unknown explains the data with all others at their best.

.. math:: L_k(v) = \max_{\theta : \theta_k = v} \log p(y \mid \theta)
          - \max_\theta \log p(y \mid \theta)

No prior enters but its support, so that a flat profile says: the data alone does not determine
:math:`\theta_k`, whatever the posterior's sd. The 95 % likelihood interval ends where :math:`L_k`
falls below -1.92 (half the quantile 3.84 of chi-squared with one degree of freedom; Raue et al.
2009).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.posterior import Posterior
from calibrate.priors import bounds
from calibrate.samplers import density_of
from emulator.core.errors import InputError
from emulator.core.minimise import minimise

DROP_95 = 1.92
_BOUND = 12.0  # bound of an unconstrained coordinate, within 1e-5 of its interval's ends
_WIDTH = 4.0  # posterior sd that the grid covers on each side of the median

LogLikelihood = Callable[[jax.Array], jax.Array]
"""Unconstrained coordinates (q,) to the log likelihood, ``-inf`` where there is no answer."""


class Profile(NamedTuple):
    """The profile of one unknown.

    values : (v,), ascending. drop : (v,) log likelihood below its maximum, 0 at the best.
    low, high : ends of the 95 % likelihood interval; infinite where the likelihood does not fall so
        far within ``values``.
    """

    values: np.ndarray
    drop: np.ndarray
    low: float
    high: float


def profile_likelihood(posterior: Posterior, name: str, points: int = 21) -> Profile:
    """Return the profile of the unknown ``name``, to four posterior sd on each side.

    Raises
    ------
    InputError
        No such unknown.
    """
    model = posterior.model
    if name not in model.names:
        raise InputError(f"profile: '{name}' is not inferred; inferred: {', '.join(model.names)}")
    density, data = density_of(model), posterior.data
    named = {n: jnp.asarray(values) for n, values in posterior.draws().items()}
    z = np.asarray(jax.jit(jax.vmap(density.unconstrain))(named))
    k = density.names.index(name)
    priors = {**model.prior, **model.noise_priors}
    limits = [_BOUND if np.isfinite(bounds(priors[n])).all() else np.inf for n in density.names]
    grid = np.median(z[:, k]) + z[:, k].std() * np.linspace(-_WIDTH, _WIDTH, points)
    grid = np.clip(grid, -limits[k], limits[k])
    along = np.median(z, axis=0) + np.zeros((points, 1))
    along[:, k] = grid
    values = np.asarray(density.constrain(jnp.asarray(along))[name])

    def log_likelihood(x: jax.Array) -> jax.Array:
        return density.log_likelihood(x, data)

    best = _profile(log_likelihood, z, k, grid, np.array(limits))
    drop = best.max() - best
    return Profile(values, drop, *_interval(values, drop))


def _profile(
    log_likelihood: LogLikelihood, z: np.ndarray, k: int, grid: np.ndarray, limits: np.ndarray
) -> np.ndarray:
    """Return the largest log likelihood at each ``grid`` value of coordinate ``k``.

    Each maximisation starts from the draw nearest in that coordinate, and from the best of the
    point before.
    """
    nuisance = np.array([j for j in range(z.shape[1]) if j != k])

    @jax.jit
    @jax.value_and_grad
    def objective(rest: jax.Array, value: jax.Array) -> jax.Array:
        return -log_likelihood(jnp.zeros(z.shape[1]).at[k].set(value).at[nuisance].set(rest))

    best, last = [], None
    for value in grid:
        starts = [z[int(np.argmin(np.abs(z[:, k] - value))), nuisance]]
        starts += [] if last is None else [last]
        low, high = -limits[nuisance], limits[nuisance]
        optima = [
            minimise(partial(objective, value=value), np.clip(s, low, high), low=low, high=high)
            for s in starts
        ]
        lowest = min(optima, key=lambda minimum: minimum.value)
        best.append(-lowest.value)
        last = lowest.x
    return np.array(best)


def _interval(values: np.ndarray, drop: np.ndarray) -> tuple[float, float]:
    """Return the points on each side of the least drop where it crosses :data:`DROP_95`."""
    best = int(np.argmin(drop))
    below, above = drop[: best + 1][::-1], drop[best:]
    return (
        _crossing(values[: best + 1][::-1], below, -np.inf),
        _crossing(values[best:], above, np.inf),
    )


def _crossing(values: np.ndarray, drop: np.ndarray, otherwise: float) -> float:
    beyond = np.flatnonzero(drop > DROP_95)
    if not beyond.size:
        return otherwise
    i = int(beyond[0])
    share = (DROP_95 - drop[i - 1]) / (drop[i] - drop[i - 1])
    return float(values[i - 1] + share * (values[i] - values[i - 1]))
