r"""The process of a cube: how far glued plates take forces from the formula's, everywhere.

.. math:: q_j(x) \sim \mathrm{GP}\big(\bar q_j,\; \sigma_j^2\, \kappa(\phi(x), \phi(x'))\big),
          \qquad \kappa = \exp\Big(-\tfrac12 \sum_f \big((\phi_f - \phi'_f) / \ell_f\big)^2\Big)

for each of the k points j of a cube's curves, through values and slopes at runs. Its distance is
taken in features :math:`\phi`, not in the position x: how far a glued cube is from a homogeneous
one depends on how anisotropic it is, which are ratios of the terms' moduli at rest and where
curves end,

.. math:: \log(1 + a_t / a), \qquad \log(1 + a_t e^{b_t g_t} / (a\, e^{b g})), \quad t = f, s, fs,

beside the isotropic term's own two positions and the angles. A term that is switched off has no
exponent, and these have none then either; in x they keep one (docs/experiments.md, "Hearts of
sheep"). Lengths :math:`\ell` are most likely given the runs, with :math:`\sigma_j` put in:

.. math:: L(\ell) = \tfrac{k}{2} \log |K| + \tfrac{n}{2} \sum_j \log (y_j^T K^{-1} y_j / n),

K the correlation of n values and slopes, y what FEM says of them. Slopes in x are slopes in
features times the features' own (chain rule), so that a prediction costs as much as one of values:

.. math:: q_j(x) = \bar q_j + \sum_r \kappa_r \Big[w_{rj} + \sum_f \frac{\phi_f - \phi_{rf}}
          {\ell_f^2}\, v_{rfj}\Big].
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize
from studies.sheep_myocardium import cube

ROWS = 75
"""Runs of a cube that a process has room for: programs are of a number of runs."""
_NUGGET = 1e-6  # variance, of one, that neither forces nor slopes tell
_SHORTEST, _LONGEST, _FIRST = 0.1, 30.0, 2.0  # lengths
_MATERIAL = tuple(p.name for p in cube.MATERIAL)
_TERMS = (("a_f", "b_f"), ("a_s", "b_s"), ("a_fs", "b_fs"))
FEATURES = 2 + 2 * len(_TERMS) + len(cube.ANGLES)


class Process(NamedTuple):
    """One cube's, arrays only.

    at : (r, f) features of runs. values : (r, k) weights w. slopes : (r, f, k) weights v.
    lengths : (f,). mean : (k,).
    """

    at: jax.Array
    values: jax.Array
    slopes: jax.Array
    lengths: jax.Array
    mean: jax.Array


def ends(amounts: np.ndarray) -> np.ndarray:
    """What exponents are multiplied by where the curves (3, j) end, (2,): of shears, of fibres.

    Sheared by g, :math:`I_1 - 3 = g^2 = I_{8fs}^2`; stretched by e, :math:`(I_4 - 1)^2` is about
    :math:`(2 e)^2`.
    """
    shear, stretch = np.abs(amounts[:2]).max(), np.abs(amounts[2]).max()
    return np.array([shear**2, (2.0 * stretch) ** 2])


def features(x: jax.Array, ends: jax.Array) -> jax.Array:
    """Features (f,) of a cube at the position ``x`` (p,) in its box."""
    theta = cube.theta_of(x)
    value = {name: theta[k] for k, name in enumerate(_MATERIAL)}
    rest, end = [], []
    for modulus, exponent in _TERMS:
        grown = ends[0] if modulus == "a_fs" else ends[1]
        ratio = jnp.log(value[modulus] / value["a"])
        rest.append(jax.nn.softplus(ratio))
        end.append(jax.nn.softplus(ratio + value[exponent] * grown - value["b"] * ends[0]))
    return jnp.concatenate([x[:2], jnp.stack(rest + end), x[len(_MATERIAL) :]])


def correction(process: Process, phi: jax.Array) -> jax.Array:
    """Mean of q (k,) at features ``phi`` (f,)."""
    step = (phi - process.at) / process.lengths
    kernel = jnp.exp(-0.5 * jnp.sum(step**2, axis=1))
    rising = jnp.einsum("rf,rfk->rk", step / process.lengths, process.slopes)
    return process.mean + kernel @ (process.values + rising)


def correlations(
    phi: jax.Array, J: jax.Array, other: jax.Array, J_other: jax.Array, lengths: jax.Array
) -> jax.Array:
    """Of values and slopes at points with those at others, (n, p + 1, m, p + 1).

    Parameters
    ----------
    phi, J : features (n, f) and their slopes (n, f, p). other, J_other : (m, f), (m, f, p).
    """
    step = (phi[:, None] - other[None]) / lengths**2
    kernel = jnp.exp(-0.5 * jnp.sum((lengths * step) ** 2, axis=2))
    of_value = jnp.einsum("nmf,mfp->nmp", step, J_other)
    of_slope = -jnp.einsum("nmf,nfp->nmp", step, J)
    between = jnp.einsum("nfp,f,mfq->nmpq", J, lengths**-2, J_other)
    between += of_slope[..., :, None] * of_value[..., None, :]
    top = jnp.concatenate([jnp.ones_like(kernel)[..., None], of_value], axis=-1)
    below = jnp.concatenate([of_slope[..., None], between], axis=-1)
    full = kernel[..., None, None] * jnp.concatenate([top[..., None, :], below], axis=-2)
    return full.transpose(0, 2, 1, 3)


class Known(NamedTuple):
    """What FEM says of a cube, with room for :data:`ROWS` runs.

    x : (r, p). phi : (r, f). J : (r, f, p). y : (r, p + 1, k) of q less its mean, and its slopes;
    zero where nothing is known. used : (r,) 1 or 0. mean : (k,).
    """

    x: jax.Array
    phi: jax.Array
    J: jax.Array
    y: jax.Array
    used: jax.Array
    mean: jax.Array

    @property
    def total(self) -> jax.Array:
        """Number of values and slopes of a point."""
        return self.used.sum() * self.y.shape[1]


@jax.jit
def with_slopes(x: jax.Array, ends: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Features (n, f) of positions (n, p) in the box, and their slopes (n, f, p)."""

    def of(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        phi = features(x, ends)
        return phi, phi

    J, phi = jax.vmap(jax.jacfwd(of, has_aux=True))(x)
    return phi, J


def known(x: np.ndarray, q: np.ndarray, slopes: np.ndarray, ends: np.ndarray) -> Known:
    """What runs say: positions (n, p), q (n, k) and its slopes (n, k, p)."""
    left = ROWS - len(x)
    if left < 0:
        raise ValueError(f"a process has room for {ROWS} runs, not for {len(x)}")
    mean = q.mean(axis=0)
    y = np.concatenate([(q - mean)[:, None], np.swapaxes(slopes, 1, 2)], axis=1)
    padded = [np.concatenate([a, np.zeros((left, *a.shape[1:]))]) for a in (x, y)]
    used = np.arange(ROWS) < len(x)
    phi, J = with_slopes(jnp.asarray(padded[0]), jnp.asarray(ends))
    rest = (jnp.asarray(a) for a in (padded[1], used.astype(float), mean))
    return Known(jnp.asarray(padded[0]), phi, J, *rest)


def _factor(told: Known, lengths: jax.Array) -> jax.Array:
    """Cholesky factor (n, n) of the correlation of all that is known; one where nothing is."""
    count = told.y.shape[0] * told.y.shape[1]
    full = correlations(told.phi, told.J, told.phi, told.J, lengths).reshape(count, count)
    used = jnp.repeat(told.used, told.y.shape[1])
    full = full * used[:, None] * used[None, :]
    return jnp.linalg.cholesky(full + jnp.diag(_NUGGET * used + 1.0 - used))


def _variances(told: Known, factor: jax.Array) -> jax.Array:
    """Most likely variances (k,), given lengths."""
    y = told.y.reshape(len(factor), -1)
    half = jax.scipy.linalg.solve_triangular(factor, y, lower=True)
    return jnp.sum(half**2, axis=0) / told.total


@jax.jit
def _unlikely(logs: jax.Array, told: Known) -> tuple[jax.Array, jax.Array]:
    """L / n of logarithms of lengths (f,), and its slopes."""

    def of(logs: jax.Array) -> jax.Array:
        factor = _factor(told, jnp.exp(logs))
        variances = _variances(told, factor)
        volume = 2.0 * jnp.sum(jnp.log(jnp.diag(factor)))
        each = 0.5 * told.total * jnp.log(variances)
        return (0.5 * len(variances) * volume + each.sum()) / told.total

    return jax.value_and_grad(of)(logs)


def likeliest(told: Known, start: np.ndarray | None = None, *, steps: int = 12) -> np.ndarray:
    """Most likely lengths (f,), or as near as ``steps`` of L-BFGS come."""
    first = np.full(FEATURES, _FIRST) if start is None else start
    found = minimize(
        lambda logs: tuple(map(np.asarray, _unlikely(jnp.asarray(logs), told))),
        np.log(first),
        jac=True,
        method="L-BFGS-B",
        bounds=[(np.log(_SHORTEST), np.log(_LONGEST))] * FEATURES,
        options={"maxiter": steps},
    )
    return np.exp(found.x) if np.isfinite(found.fun) else first


@jax.jit
def conditioned(told: Known, lengths: jax.Array) -> Process:
    """The process of what is known."""
    factor = _factor(told, lengths)
    y = told.y.reshape(len(factor), -1)
    weights = jax.scipy.linalg.cho_solve((factor, True), y).reshape(told.y.shape)
    weights = weights * told.used[:, None, None]
    slopes = jnp.einsum("rfp,rpk->rfk", told.J, weights[:, 1:])
    return Process(told.phi, weights[:, 0], slopes, lengths, told.mean)


@jax.jit
def left(
    told: Known, lengths: jax.Array, phi: jax.Array, J: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Correlation (m (p + 1), m (p + 1)) of values and slopes at points that runs leave.

    The second is the largest sd of q over the points of the curves.
    """
    factor = _factor(told, lengths)
    used = jnp.repeat(told.used, told.y.shape[1])
    between = correlations(phi, J, told.phi, told.J, lengths)
    size = between.shape[0] * between.shape[1]
    half = jax.scipy.linalg.solve_triangular(
        factor, (between.reshape(size, len(used)) * used).T, lower=True
    )
    prior = correlations(phi, J, phi, J, lengths).reshape(size, size)
    return prior - half.T @ half, jnp.sqrt(_variances(told, factor).max())


def next_runs(covariance: np.ndarray, points: int, count: int) -> list[int]:
    """The runs, of ``points`` that may be, after which least variance of q is left at them all.

    Greedy: what a run (a value and its slopes, block i of the covariance (m (p + 1), m (p + 1)))
    takes away, summed over all points, is :math:`tr(C_{vi} C_{ii}^{-1} C_{iv})`, v the values.
    """
    C = np.array(covariance)
    size = len(C) // points
    blocks = np.arange(len(C)).reshape(points, size)
    chosen: list[int] = []
    for _ in range(count):
        gains = np.empty(points)
        for i, rows in enumerate(blocks):
            own = C[np.ix_(rows, rows)] + _NUGGET * np.eye(size)
            to_values = C[np.ix_(rows, blocks[:, 0])]
            gains[i] = np.sum(to_values * np.linalg.solve(own, to_values))
        gains[chosen] = -np.inf
        best = int(gains.argmax())
        rows = blocks[best]
        own = C[np.ix_(rows, rows)] + _NUGGET * np.eye(size)
        C -= C[:, rows] @ np.linalg.solve(own, C[rows])
        chosen.append(best)
    return chosen
