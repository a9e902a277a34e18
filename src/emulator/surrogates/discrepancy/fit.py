r"""A map's residual, as Gaussian processes of its principal modes.

.. math:: u(\theta) \approx m(\theta) + \bar e + \sum_k c_k(x)\, \phi_k

with :math:`m` a map made before the runs (none, a Taylor series, a network), the modes those of the
residuals and their slopes together, and :math:`c_k` a process conditioned on values *and* slopes
(:mod:`emulator.surrogates.discrepancy.kernel`). A run with its slopes counts as p + 1 observations
for a tenth more time.

A stationary kernel in theta misjudges a body that is stiff in one corner of the box and soft in the
other. Its distance is therefore taken between features that know some mechanics: theta's position,
and the leading coefficients of the Taylor series about the centre, which change fast where the body
does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from sklearn.utils.extmath import randomized_svd

from emulator.errors import InputError
from emulator.fem.campaign import Runs
from emulator.scenes.scene import Scene
from emulator.surrogates.discrepancy.kernel import Features, fit_lengths, fit_weights, fold, mean
from emulator.surrogates.taylor import Expansion, monomials

Mean = Callable[[jax.Array], jax.Array]
"""Position in the box (p,) to displacement (n, 3) mm."""

_SLOPE_WEIGHT = 0.3  # of a slope among the snapshots: typical step over typical box
_TRUNCATION = 1e-7  # of the largest singular value
_MOST_MODES = 120
_FITTED_MODES = 20  # that decide on the lengths
_MOST_OBSERVATIONS = 500  # that decide on the lengths
_FEATURES = 4
_FEATURE_SAMPLES = 400


class Warp(NamedTuple):
    """Features of a position: itself and polynomials of it, each divided by its length.

    centre : (p,). indices : (t, o) Taylor multi-indices. coefficients : (t, f).
    inverse_lengths : (p + f,).
    """

    centre: np.ndarray
    indices: np.ndarray
    coefficients: jax.Array
    inverse_lengths: jax.Array

    def __call__(self, position: jax.Array) -> jax.Array:
        """Features (p + f,) of ``position`` (p,)."""
        polynomials = monomials(self.indices, position - self.centre) @ self.coefficients
        return jnp.concatenate([position, polynomials]) * self.inverse_lengths

    def with_slopes(self, positions: jax.Array) -> Features:
        """Features of ``positions`` (c, p) and their derivatives."""
        features: Callable[[jax.Array], jax.Array] = self.__call__
        return Features(jax.vmap(features)(positions), jax.vmap(jax.jacfwd(features))(positions))


@dataclass(frozen=True, eq=False)
class Residual:
    """What to add to a map.

    warp : features of a position. known : (c, q) those of the runs.
    values, slopes : (c, r) and (c, q, r) folded weights.
    offset : (k, 3) mm. modes : (r, k, 3) mm.
    """

    warp: Warp
    known: jax.Array
    values: jax.Array
    slopes: jax.Array
    offset: jax.Array
    modes: jax.Array

    def coefficients(self, position: jax.Array) -> jax.Array:
        """Of the modes (r,) at ``position`` (p,) in the box."""
        return mean(self.warp(position), self.known, self.values, self.slopes)

    def __call__(self, position: jax.Array) -> jax.Array:
        """Displacement (k, 3) in mm to add at ``position`` (p,)."""
        return self.offset + jnp.tensordot(self.coefficients(position), self.modes, axes=1)


def fit_residual(
    scene: Scene, runs: Runs, expansion: Expansion, mean_map: Mean | None = None
) -> Residual:
    """Fit what ``mean_map`` leaves of FEM ``runs`` that have slopes.

    Parameters
    ----------
    expansion : the Taylor series whose leading coefficients warp the inputs.
    mean_map : a map that is good already, differentiable; ``None`` is zero.

    Raises
    ------
    InputError
        Fewer than two runs, runs without slopes or not finite, an expansion of another scene, or a
        map that leaves nothing to fit.
    """
    _check(scene, runs, expansion)
    positions = scene.to_unit(jnp.asarray(runs.theta))
    fields, slopes = _left(runs, positions, mean_map)
    offset = fields.mean(axis=0)
    modes, observations = _project(fields - offset, slopes)
    warp = _warp(expansion, positions.shape[1])
    features = warp.with_slopes(positions)
    lengths = _lengths(features, np.asarray(positions), observations)
    warp = warp._replace(inverse_lengths=lengths)
    scaled = features.scaled(lengths)
    values, folded = fold(scaled, fit_weights(scaled, observations))
    return Residual(
        warp=warp,
        known=scaled.value,
        values=values,
        slopes=folded,
        offset=jnp.asarray(offset),
        modes=jnp.asarray(modes.reshape(-1, *offset.shape)),
    )


def _check(scene: Scene, runs: Runs, expansion: Expansion) -> None:
    count = len(runs.theta)
    if runs.slopes is None:
        raise InputError(f"a residual needs FEM runs with slopes; these {count} have none")
    if count < 2:
        raise InputError(f"a residual needs 2 FEM runs or more; there is {count}")
    parameters = len(scene.parameters)
    if len(expansion.centre) != parameters:
        raise InputError(
            f"scene '{scene.name}' has {parameters} parameters; "
            f"the expansion is in {len(expansion.centre)}"
        )
    for what in ("theta", "displacement", "slopes"):
        each = np.isfinite(np.asarray(getattr(runs, what))).reshape(count, -1).all(axis=1)
        if not each.all():
            raise InputError(f"FEM run {int(np.argmin(each))}: {what} not finite")


def _left(runs: Runs, positions: jax.Array, mean_map: Mean | None) -> tuple[np.ndarray, np.ndarray]:
    """What the mean leaves of the fields (c, n, 3) and of their slopes (c, p, n, 3)."""
    fields, slopes = np.asarray(runs.displacement), np.array(runs.slopes)
    if mean_map is None:
        return fields, slopes
    fields = fields - np.asarray(jax.jit(jax.vmap(mean_map))(positions))
    jacobian = jax.jit(jax.jacfwd(mean_map))
    for k, position in enumerate(positions):
        slopes[k] -= np.moveaxis(np.asarray(jacobian(position)), -1, 0)
    if not (np.isfinite(fields).all() and np.isfinite(slopes).all()):
        raise InputError("a residual was asked for, but the map is not finite at every FEM run")
    return fields, slopes


def _project(fields: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, jax.Array]:
    """Modes (r, 3n) in mm, and the coefficients of fields and slopes (c (1 + p), r)."""
    count, parameters = slopes.shape[:2]
    fields, slopes = fields.reshape(count, -1), slopes.reshape(count, parameters, -1)
    snapshots = np.concatenate([fields, _SLOPE_WEIGHT * slopes.reshape(count * parameters, -1)])
    wanted = min(_MOST_MODES, *snapshots.shape)
    _, size, right = randomized_svd(snapshots, wanted, n_iter=4, random_state=0)
    kept = size > max(_TRUNCATION * size[0], np.finfo(float).tiny)
    if not kept.any():
        raise InputError("a residual was asked for, but the map leaves none")
    scale = size[kept] / np.sqrt(len(snapshots))
    both = np.concatenate([fields[:, None], slopes], axis=1) @ (right[kept].T / scale)
    return right[kept] * scale[:, None], jnp.asarray(both.reshape(-1, kept.sum()))


def _lengths(features: Features, positions: np.ndarray, observations: jax.Array) -> jax.Array:
    """Inverse lengths (q,) from some of the runs and the leading modes."""
    each = 1 + positions.shape[1]
    chosen = _spread(positions, max(4, _MOST_OBSERVATIONS // each))
    rows = (chosen[:, None] * each + np.arange(each)).ravel()
    some = Features(features.value[chosen], features.slope[chosen])
    return jnp.asarray(fit_lengths(some, observations[rows][:, :_FITTED_MODES]))


def _warp(expansion: Expansion, parameters: int) -> Warp:
    """Position, and the coefficients of the series' own leading modes over the box."""
    if not len(expansion.indices):
        plain = jnp.zeros((0, 0))
        return Warp(expansion.centre, expansion.indices, plain, jnp.ones(parameters))
    derivatives = np.asarray(expansion.derivatives).reshape(len(expansion.indices), -1)
    samples = np.random.default_rng(0).random((_FEATURE_SAMPLES, parameters))
    weights = np.asarray(expansion.monomials(jnp.asarray(samples)))
    # Left singular vectors of the sampled fields, through the small Gram matrix.
    values, vectors = np.linalg.eigh(derivatives @ derivatives.T)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    _, size, right = np.linalg.svd(weights @ root, full_matrices=False)
    count = min(_FEATURES, int(np.sum(size > 1e-6 * size[0])))
    coefficients = (root @ right[:count].T) / (size[:count] / np.sqrt(_FEATURE_SAMPLES))
    return Warp(
        expansion.centre,
        expansion.indices,
        jnp.asarray(coefficients),
        jnp.ones(parameters + count),
    )


def _spread(positions: np.ndarray, count: int) -> np.ndarray:
    """Rows of at most ``count`` different positions, each far from those before it."""
    chosen = [0]
    distance = np.full(len(positions), np.inf)
    while len(chosen) < min(count, len(positions)):
        distance = np.minimum(distance, np.sum((positions - positions[chosen[-1]]) ** 2, axis=1))
        if not distance.max() > 0.0:
            break
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)
