r"""The process of a cube: how far glued plates take forces from the formula's, everywhere.

.. math:: q_j(x) \sim \mathrm{GP}\big(\bar q_j,\; \sigma_j^2\, \kappa(\phi(x), \phi(x'))\big),
          \qquad \kappa = \exp\Big(-\tfrac12 \sum_f \big((\phi_f - \phi'_f) / \ell_f\big)^2\Big)

for each of the k points j of a cube's curves, through values and slopes at runs. Its distance is
taken in features :math:`\phi`, not in the position x: how far a glued cube is from a homogeneous
one depends on how anisotropic it is, at rest and where each of its six half curves ends,

.. math:: \log(1 + a_t / a), \qquad
          \log\Big(1 + \frac{a_t\, g_t\, e^{b_t g_t}}{a\, (I_1 - 3)\, e^{b (I_1 - 3)}}\Big),
          \quad t = f, s, fs, \quad g_f = (I_{4f} - 1)_+^2, \; g_s = (I_{4s} - 1)_+^2, \;
          g_{fs} = I_{8fs}^2,

with the invariants of the homogeneous cube, whose fibres are turned by the angles; beside the
isotropic term's own two positions and the angles. A term that is switched off has no exponent, and
these have none then either; in x they keep one. Where oblique fibres are stretched, the formula's
exponent is what FEM's force is far from, and without the ends' own invariants a posterior finds
regions where a process is wrong (docs/experiments.md, "Hearts of sheep").

Lengths :math:`\ell` are most likely given the runs, with :math:`\sigma_j` put in:

.. math:: L(\ell) = \tfrac{k}{2} \log |K| + \tfrac{n}{2} \sum_j \log (y_j^T K^{-1} y_j / n),

K the correlation of n values and slopes, y what FEM says of them. Each of these numbers is
:math:`v\, q + d \cdot \nabla_\phi q` at a run's features: a value (v = 1, d = 0), or a slope in x
(v = 0, d the features' own slope, by the chain rule). With
:math:`\Lambda = \mathrm{diag}\,\ell^{-2}` and :math:`\Delta = \phi - \phi'` two of them have the
correlation

.. math:: \kappa\, [(v - d^T \Lambda \Delta)(v' + d'^T \Lambda \Delta) + d^T \Lambda\, d'],

and c(x) is that of a value at x with all n, which makes

.. math:: E\, q_j = \bar q_j + c^T K^{-1} y_j, \qquad
          \mathrm{cov}(q_i, q_j) = B_{ij}\, \lambda, \quad \lambda = 1 - c^T K^{-1} c, \quad
          B = y^T K^{-1} y / n.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize
from studies.sheep_myocardium import cube

ROOM = 80
"""Runs of a cube that a process has room for, or a multiple: programs are of a number of runs."""
_NUGGET = 1e-6  # variance, of one, that neither forces nor slopes tell
_SHORTEST, _LONGEST, _FIRST = 0.1, 30.0, 2.0  # lengths
_MATERIAL = tuple(p.name for p in cube.MATERIAL)
_TERMS = (("a_f", "b_f"), ("a_s", "b_s"), ("a_fs", "b_fs"))
_ENDS = 6  # of the three curves of a cube
FEATURES = 2 + (1 + _ENDS) * len(_TERMS) + len(cube.ANGLES)


class Process(NamedTuple):
    """One cube's, arrays only.

    at : (r, f) features of runs. along : (r, f, p) their slopes. weights : (r, p + 1, k) of each
    run's value and slopes, :math:`K^{-1} y`. lengths : (f,). mean : (k,).
    """

    at: jax.Array
    along: jax.Array
    weights: jax.Array
    lengths: jax.Array
    mean: jax.Array


def features(number: int, x: jax.Array, H: jax.Array) -> jax.Array:
    """Features (f,) of the cube ``number`` at the position ``x`` (p,) in its box.

    H : (3, j, 3, 3) gradients of its homogeneous curves, see :func:`.cube.homogeneous`.
    """
    theta = cube.theta_of(x)
    value = {name: theta[k] for k, name in enumerate(_MATERIAL)}
    rest = [jnp.log1p(value[modulus] / value["a"]) for modulus, _ in _TERMS]
    ends = jax.vmap(lambda H: _at_end(value, cube.turned_to(number, x), H))(
        H[:, jnp.array([0, -1])].reshape(-1, 3, 3)
    )
    return jnp.concatenate([x[:2], jnp.stack(rest), ends.reshape(-1), x[len(_MATERIAL) :]])


def _at_end(value: dict[str, jax.Array], directions: jax.Array, H: jax.Array) -> jax.Array:
    """Of each term (3,) its share, beside the isotropic one, where a curve ends."""
    F = jnp.eye(3) + H
    C = F.T @ F
    fibre, sheet = directions
    more = jnp.trace(C) - 3.0
    stretched = [jnp.maximum(v @ C @ v - 1.0, 0.0) ** 2 for v in (fibre, sheet)]
    shares = []
    for (modulus, exponent), g in zip(_TERMS, (*stretched, (fibre @ C @ sheet) ** 2), strict=True):
        grown = jnp.exp(value[exponent] * g - value["b"] * more)
        shares.append(jnp.log1p(value[modulus] / value["a"] * g / more * grown))
    return jnp.stack(shares)


def correction(process: Process, phi: jax.Array) -> jax.Array:
    """Mean of q (k,) at features ``phi`` (f,)."""
    step = (phi - process.at) / process.lengths
    kernel = jnp.exp(-0.5 * jnp.sum(step**2, axis=1))
    rising = jnp.einsum("rf,rfp->rp", step / process.lengths, process.along)
    c = kernel[:, None] * jnp.concatenate([jnp.ones((len(step), 1)), rising], axis=1)
    # As one product, a fifth of the time of an einsum over both.
    return process.mean + c.reshape(-1) @ process.weights.reshape(c.size, -1)


class Told(NamedTuple):
    """Numbers that are each a value or a slope of q.

    at : (n, f) features. value : (n,) v. along : (n, f) d.
    """

    at: np.ndarray
    value: np.ndarray
    along: np.ndarray

    @property
    def size(self) -> int:
        """How many."""
        return len(self.at)


@partial(jax.jit, static_argnums=0)
def _with_slopes(number: int, x: jax.Array, H: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Features (f,) of a position (p,) in the box, and their slopes (f, p)."""
    return features(number, x, H), jax.jacfwd(features, argnums=1)(number, x, H)


def values_and_slopes(number: int, x: np.ndarray, H: jax.Array) -> tuple[Told, np.ndarray]:
    """Of positions (n, p) in the box, each a value and its p slopes; and features' (n, f, p)."""
    phi, J = map(np.stack, zip(*(_with_slopes(number, row, H) for row in x), strict=True))
    count, p = x.shape
    along = np.concatenate([np.zeros((count, 1, FEATURES)), np.swapaxes(J, 1, 2)], axis=1)
    value = np.tile(np.arange(p + 1) == 0, count).astype(float)
    return Told(np.repeat(phi, p + 1, axis=0), value, along.reshape(-1, FEATURES)), J


_features = jax.jit(jax.vmap(features, (None, 0, None)), static_argnums=0)


def values(number: int, x: np.ndarray, H: jax.Array) -> Told:
    """Of positions (n, p) in the box, a value each."""
    phi = np.asarray(_features(number, jnp.asarray(x), H))
    return Told(phi, np.ones(len(phi)), np.zeros_like(phi))


class _Parts(NamedTuple):
    """Of a correlation (n, m): the kernel, and v - d L D and v' + d' L D that it multiplies."""

    kernel: np.ndarray
    first: np.ndarray
    second: np.ndarray


def _correlations(a: Told, b: Told, lengths: np.ndarray) -> tuple[np.ndarray, _Parts]:
    scaled_a, scaled_b = a.at / lengths, b.at / lengths
    along_a, along_b = a.along / lengths, b.along / lengths
    squares = (scaled_a**2).sum(axis=1)[:, None] + (scaled_b**2).sum(axis=1)
    kernel = np.exp(scaled_a @ scaled_b.T - 0.5 * squares)
    first = (a.value - (along_a * scaled_a).sum(axis=1))[:, None] + along_a @ scaled_b.T
    second = b.value - (along_b * scaled_b).sum(axis=1) + scaled_a @ along_b.T
    return kernel * (first * second + along_a @ along_b.T), _Parts(kernel, first, second)


def correlations(a: Told, b: Told, lengths: np.ndarray) -> np.ndarray:
    """Of numbers (n,) with others (m,), (n, m)."""
    return _correlations(a, b, lengths)[0]


def _pulled_back(
    told: Told, weights: np.ndarray, K: np.ndarray, parts: _Parts, lengths: np.ndarray
) -> np.ndarray:
    """Slopes (f,) in logarithms of lengths of the sum of ``weights`` (n, n) times K (n, n)."""
    kernel, first, second = parts
    at, along = told.at, told.along
    B = weights * kernel
    M, P, Q = weights * K, B * first, B * second

    def moved(W: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Sum over pairs of W_ij left_i right_j, by feature."""
        return (left * (W @ right)).sum(axis=0)

    one = np.ones_like(at)
    by_squares = -0.5 * (moved(M, at**2, one) - 2.0 * moved(M, at, at) + moved(M, one, at**2))
    by_first = -moved(Q, along * at, one) + moved(Q, along, at)
    by_second = moved(P, at, along) - moved(P, one, along * at)
    return -2.0 * (by_squares + by_first + by_second + moved(B, along, along)) / lengths**2


class Known(NamedTuple):
    """What FEM says of a cube: ``told`` numbers are ``y`` (n, k), less the mean (k,) if values.

    J : (r, f, p) slopes of features at its runs.
    """

    told: Told
    y: np.ndarray
    mean: np.ndarray
    J: np.ndarray

    @property
    def runs(self) -> int:
        """How many."""
        return len(self.J)


def known(number: int, x: np.ndarray, q: np.ndarray, slopes: np.ndarray, H: jax.Array) -> Known:
    """What runs of a cube say: positions (n, p), q (n, k) and its slopes (n, k, p)."""
    mean = q.mean(axis=0)
    y = np.concatenate([(q - mean)[:, None], np.swapaxes(slopes, 1, 2)], axis=1)
    told, J = values_and_slopes(number, x, H)
    return Known(told, y.reshape(told.size, -1), mean, J)


def _factored(K: np.ndarray) -> np.ndarray:
    """Cholesky factor (n, n) of a correlation, with the nugget."""
    return cholesky(K + _NUGGET * np.eye(len(K)), lower=True, overwrite_a=True)


def _factor(known: Known, lengths: np.ndarray) -> np.ndarray:
    return _factored(correlations(known.told, known.told, lengths))


def _unlikely(logs: np.ndarray, known: Known) -> tuple[float, np.ndarray]:
    """L / n of logarithms of lengths (f,), and its slopes."""
    lengths, (n, k) = np.exp(logs), known.y.shape
    K, parts = _correlations(known.told, known.told, lengths)
    factor = _factored(K)
    weights = cho_solve((factor, True), known.y)
    misfits = (known.y * weights).sum(axis=0)
    value = k * np.log(np.diag(factor)).sum() + 0.5 * n * np.log(misfits / n).sum()
    lower = np.tril(dpotri(factor, lower=True)[0])
    inverse = lower + np.tril(lower, -1).T
    by_K = 0.5 * k * inverse - 0.5 * n * (weights / misfits) @ weights.T
    return value / n, _pulled_back(known.told, by_K, K, parts, lengths) / n


def likeliest(known: Known, start: np.ndarray | None = None, *, steps: int = 12) -> np.ndarray:
    """Most likely lengths (f,), or as near as ``steps`` of L-BFGS come."""
    first = np.full(FEATURES, _FIRST) if start is None else start
    found = minimize(
        _unlikely,
        np.log(first),
        args=(known,),
        jac=True,
        method="L-BFGS-B",
        bounds=[(np.log(_SHORTEST), np.log(_LONGEST))] * FEATURES,
        options={"maxiter": steps},
    )
    return np.exp(found.x) if np.isfinite(found.fun) else first


def room(runs: int) -> int:
    """Runs that a process of ``runs`` has room for."""
    return ROOM * max(1, -(-runs // ROOM))


def conditioned(known: Known, lengths: np.ndarray, rows: int) -> Process:
    """The process of what is known, with room for as many runs as ``rows``."""
    factor = _factor(known, lengths)
    count, _, p = known.J.shape
    weights = cho_solve((factor, True), known.y).reshape(count, p + 1, -1)
    parts = known.told.at[:: p + 1], known.J, weights
    empty = rows - count
    padded = (np.concatenate([a, np.zeros((empty, *a.shape[1:]))]) for a in parts)
    return Process(*map(jnp.asarray, (*padded, lengths, known.mean)))


def left(known: Known, lengths: np.ndarray, points: Told) -> np.ndarray:
    """Correlation (m, m) of numbers that runs leave."""
    between = correlations(known.told, points, lengths)
    half = solve_triangular(_factor(known, lengths), between, lower=True)
    return correlations(points, points, lengths) - half.T @ half


def shares(known: Known, lengths: np.ndarray, values: Told) -> tuple[np.ndarray, np.ndarray]:
    """Share (m,) of the variance of q that runs leave at ``values``, and B (k, k) it is of."""
    factor = _factor(known, lengths)
    half = solve_triangular(factor, correlations(known.told, values, lengths), lower=True)
    explained = solve_triangular(factor, known.y, lower=True)
    share = np.maximum(1.0 - (half**2).sum(axis=0), 0.0)
    return share, explained.T @ explained / len(explained)


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
