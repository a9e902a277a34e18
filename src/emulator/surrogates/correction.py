r"""The correction of a forward map that FEM runs teach: a Gaussian process of its errors.

At some theta FEM was solved, and the map misses the data's means by :math:`D`; a map that knows
nothing misses all of them. In places FEM's derivatives say how the miss changes, too,
:math:`D' = \partial D / \partial x`. Between the runs

.. math:: d(x) = k(x, X)\, K^{-1} [D, D'], \quad
    k(x, x') = v (1 + x \cdot x') + e^{-\rho / 2}, \quad \rho = |x - x'|^2 / \ell^2

for all data at once, with theta standardised, :math:`x`, and a linear trend of wide prior
:math:`v`. A derivative is an observation of covariance

.. math::
    \partial_{x'} k = v\, x + \frac{x - x'}{\ell^2}\, e^{-\rho / 2}, \qquad
    \partial_x \partial_{x'} k = v I + \left(\frac{I}{\ell^2}
        - \frac{(x - x')(x - x')^T}{\ell^4}\right) e^{-\rho / 2}

so that a run with its derivatives says as much as :math:`1 + q` runs. :math:`K` has :math:`\tau^2`
added to the unit variance of each observation. :math:`\ell` and :math:`\tau` minimise the errors at
runs left out, which for a Gaussian process have a closed form: with all observations :math:`y` of
a run in the block :math:`b`, the error is :math:`(K^{-1}_{bb})^{-1} (K^{-1} y)_b` (Rasmussen and
Williams 2006, Eq. 5.10-5.12, for blocks). The size of these errors also sets the scale :math:`a^2`
of the process's variance, in squared noise sd,

.. math:: v(x) = a^2 (k(x, x) + \tau^2 - k(x, X)\, K^{-1} k(X, x)) .

A wrong correction costs precision, not correctness: :math:`v` only says where to solve FEM next,
and FEM at fresh points tests what the correction predicts (:mod:`calibrate.certificate.check`). A
bump far from the posterior may spoil a process everywhere. So there are three candidates, a process
of all points, one of those that FEM finds likely, and none; errors at the likely ones decide.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.gaussian_process import Regression, squared_exponential

_LENGTHS = (0.25, 0.5, 1.0, 2.0, 4.0)  # correlation lengths that are compared, in sd of the points
_NUGGETS = (1e-6, 1e-4, 1e-2, 1.0, 1e2)
_FIRST_NUGGETS = (1e-6, 1e-2)  # with which lengths are compared
_TREND = 1e2
_MOST_OBSERVATIONS = 800  # beyond which derivatives at points that FEM finds unlikely are left out
_SMOOTH = 10.0  # sds of the points that are the unit of features where errors hardly vary
_NEGLIGIBLE = 1e-3  # leave-one-out error, in noise sd, that changes no posterior


class Correction(NamedTuple):
    r"""A fitted Gaussian process; all zeros for no correction.

    at : the features (n, q) of theta where FEM was solved, standardised; rows of zeros may be
        padding.
    observed : the numbers (N,) of the observations, of 1 + q a run: its value, its derivatives.
    weights : the weights (N, m) of the observations, zero in rows of padding.
    inverse : the inverse (N, N) of their covariance, zero in rows of padding.
    centre, width : the mean and sd (q,) of the features, by which they are standardised.
    length, nugget, scale : :math:`\\ell`, :math:`\\tau^2` and :math:`a^2` of the kernel.
    local : whether it was fitted to likely points alone.
    """

    at: np.ndarray
    observed: np.ndarray
    weights: np.ndarray
    inverse: np.ndarray
    centre: np.ndarray
    width: np.ndarray
    length: float
    nugget: float
    scale: float
    local: bool

    def of_scaled(self, centre: np.ndarray, width: np.ndarray) -> Correction:
        """Return the correction of features that are not yet standardised by ``centre, width``."""
        return self._replace(centre=centre + width * self.centre, width=width * self.width)


def no_correction(rows: int, features: int, data: int, observations: int = 0) -> Correction:
    """Return the correction that is zero, of the shape of one fitted to ``rows`` points.

    observations : their number, for which there is room; with derivatives more than the points.
    """
    room = max(rows, 1)
    while room < observations:
        room *= 2  # few shapes, for each of which programs are compiled
    at, observed = np.zeros((rows, features)), np.zeros(room, dtype=int)
    weights, inverse = np.zeros((room, data)), np.zeros((room, room))
    centre, width = np.zeros(features), np.ones(features)
    return Correction(at, observed, weights, inverse, centre, width, 1.0, 0.0, 0.0, local=False)


def _covariance(x: np.ndarray, length: float) -> np.ndarray:
    """Return the covariance (n, 1 + q, n, 1 + q) of values and derivatives at features (n, q)."""
    count, features = x.shape
    gap = (x[:, None] - x) / length
    bell = squared_exponential((gap**2).sum(axis=-1))
    step = gap * bell[..., None] / length
    K = np.empty((count, 1 + features, count, 1 + features))
    K[:, 0, :, 0] = _TREND * (1.0 + x @ x.T) + bell
    K[:, 0, :, 1:] = _TREND * x[:, None] + step
    K[:, 1:, :, 0] = K[:, 0, :, 1:].transpose(1, 2, 0)
    identity = np.eye(features)
    curved = (identity - gap[..., None] * gap[..., None, :]) * bell[..., None, None] / length**2
    K[:, 1:, :, 1:] = (_TREND * identity + curved).transpose(0, 2, 1, 3)
    return K


def _kernel(c: Correction, x: jax.Array) -> jax.Array:
    """Return the covariances (N,) of the value at standardised features ``x`` (q,)."""
    gap = (x - c.at) / c.length
    bell = squared_exponential(jnp.sum(gap**2, axis=-1))
    value = _TREND * (1.0 + c.at @ x) + bell
    slopes = _TREND * x + gap * bell[:, None] / c.length
    return jnp.concatenate([value[:, None], slopes], axis=1).ravel()[c.observed]


def correction_at(c: Correction, x: jax.Array) -> jax.Array:
    """Return the correction (m,) at features ``x`` (q,)."""
    return _kernel(c, (x - c.centre) / c.width) @ c.weights


def correct(correction: Correction, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the correction (m,) at features ``x`` (q,), and its variance in squared noise sd."""
    c = correction
    x = (x - c.centre) / c.width
    kernel = _kernel(c, x)
    prior_variance = _TREND * (1.0 + x @ x) + 1.0 + c.nugget
    variance = c.scale * jnp.maximum(prior_variance - kernel @ c.inverse @ kernel, c.nugget)
    return kernel @ c.weights, variance


@jax.jit
def corrections(correction: Correction, x: jax.Array) -> jax.Array:
    """Return the correction (s, m) at features ``x`` (s, q)."""
    return jax.vmap(lambda row: correction_at(correction, row))(x)


def fit_correction(
    x: np.ndarray,
    errors: np.ndarray,
    scales: np.ndarray,
    rows: int,
    likely: np.ndarray | None = None,
    like: Correction | None = None,
    slopes: np.ndarray | None = None,
    *,
    exact: bool = False,
) -> Correction:
    """Return the best of a Gaussian process of all points, one of likely points, and none.

    Parameters
    ----------
    x : the features (n, q) at which FEM was solved.
    errors : FEM's data less the map's there, (n, m).
    scales : the noise sd (m,) of each datum, the unit of leave-one-out errors.
    rows : the number of points to which the result is padded with zeros, so that programs are
        compiled once.
    likely : (n,) bool, points that FEM finds likely, which decide what is best; all by default.
    like : the correction whose points and kernel are taken; by default they are searched for.
    slopes : the derivatives (n, q, m) of the errors in the features, NaN for a run without them.
    exact : whether the errors hardly vary over the points, and have no bump, so that a process of
        small slopes and long lengths passes through all of them. "None" is then no candidate: of as
        many points as unknowns, each left out is so badly continued by the others that none would
        seem better, whatever the errors are.
    """
    every = np.ones(len(x), dtype=bool)
    likely = every if likely is None or not likely.any() else likely
    parts = [every]
    # Precise data: the map misses far away by so much that errors near the posterior are hidden.
    if x.shape[1] + 2 <= likely.sum() < len(x):
        parts.append(likely)
    if like is not None and like.nugget > 0.0:
        parts = parts[-1:] if like.local else parts[:1]
    else:
        like = None
    observed = _observations(errors, slopes, x.shape[1], likely)
    squared_errors = np.mean((errors / scales) ** 2, axis=1)
    best = no_correction(rows, x.shape[1], errors.shape[1])._replace(
        scale=float(np.mean(squared_errors / (_TREND * (x**2).sum(axis=1) + _TREND + 1.0)))
    )
    smallest = np.log(squared_errors[likely] + _NEGLIGIBLE**2).mean()
    for used in parts:
        part = x[used], observed[used], scales, rows, likely[used]
        fitted, loss = _fitted(*part, like, exact=exact)
        if exact or loss < smallest:
            best, smallest = fitted._replace(local=used is not every), loss
    return best


def _observations(
    errors: np.ndarray, slopes: np.ndarray | None, features: int, likely: np.ndarray
) -> np.ndarray:
    """Return errors and derivatives (n, 1 + q, m), NaN where they are unknown or too many."""
    count, data = errors.shape
    observed = np.full((count, 1 + features, data), np.nan)
    observed[:, 0] = errors
    if slopes is not None:
        known = np.isfinite(slopes).all(axis=(1, 2))
        room = max(_MOST_OBSERVATIONS - count, 0) // features
        first = np.argsort(~(known & likely), kind="stable")
        rows = [k for k in first if known[k]][:room]
        observed[rows, 1:] = slopes[rows]
    return observed


def _fitted(
    x: np.ndarray,
    observed: np.ndarray,
    scales: np.ndarray,
    rows: int,
    likely: np.ndarray,
    like: Correction | None,
    *,
    exact: bool,
) -> tuple[Correction, float]:
    """Return the process of these points, and the mean log of its errors where it is ``likely``.

    observed : the errors and their derivatives (n, 1 + q, m), NaN where there are none.
    like : the correction whose kernel is taken; None to search for one.
    exact : as of :func:`fit_correction`.
    """
    count, per_run, data = observed.shape
    width = x.std(axis=0) * (_SMOOTH if exact else 1.0)
    centre, width = x.mean(axis=0), np.where(width > 0.0, width, 1.0)
    x = (x - centre) / width
    known = np.isfinite(observed).all(axis=2).ravel()
    units = np.concatenate([[1.0], width])[:, None]  # of derivatives in standardised features
    y = (observed * units).reshape(-1, data)[known]
    runs = np.repeat(np.arange(count), per_run)[known]
    blocks = [np.flatnonzero(runs == k) for k in range(count)]

    def process(length: float, nugget: float) -> _Process:
        kernel = _covariance(x, length).reshape(len(known), -1)[np.ix_(known, known)]
        # Beside the trend, values have the variance 1, and derivatives that of a bump this long.
        noise = np.where(np.arange(len(known)) % per_run == 0, 1.0, length**-2.0)[known]
        regression = Regression.of(kernel + nugget * np.diag(noise))
        inverse, weights = regression.inverse(), regression.weights(y)
        # Errors of runs left out, in noise sd, and their variances up to a^2.
        left_out = [Regression.of(inverse[np.ix_(b, b)]).weights(np.eye(len(b), 1)) for b in blocks]
        variance = np.array([column[0, 0] for column in left_out])
        error = np.array([c[:, 0] @ weights[b] for c, b in zip(left_out, blocks, strict=True)])
        square = np.mean((error / scales) ** 2, axis=1)
        # The mean of the logarithm over the points, so that the prior's corners do not decide.
        losses, scale = np.log(square + _NEGLIGIBLE**2), float(np.mean(square / variance))
        where_likely = float(losses[likely].mean())
        return _Process(float(losses.mean()), where_likely, length, nugget, scale, weights, inverse)

    if like is None:
        processes = [process(*kernel) for kernel in product(_LENGTHS, _FIRST_NUGGETS)]
        length = min(processes, key=lambda p: p.loss).length
        processes += [process(length, n) for n in _NUGGETS if n not in _FIRST_NUGGETS and not exact]
    else:
        processes = [process(like.length, like.nugget)]
    best = min(processes, key=lambda p: p.loss)
    size = len(best.inverse)
    fitted = no_correction(rows, per_run - 1, data, size)
    fitted.at[:count], fitted.observed[:size] = x, np.flatnonzero(known)
    fitted.weights[:size], fitted.inverse[:size, :size] = best.weights, best.inverse
    kernel = {name: getattr(best, name) for name in ("length", "nugget", "scale")}
    return fitted._replace(centre=centre, width=width, **kernel), best.where_likely


class _Process(NamedTuple):
    """A Gaussian process of one kernel, and its losses: mean logs of squared errors left out."""

    loss: float
    where_likely: float
    length: float
    nugget: float
    scale: float
    weights: np.ndarray
    inverse: np.ndarray
