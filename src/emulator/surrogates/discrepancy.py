r"""Discrepancy models: Gaussian processes of the principal modes of a map's errors against FEM.

.. math:: u(\theta) \approx m(\theta) + \bar e + \sum_k c_k(x)\, \phi_k

with :math:`m` a map made before the runs (none, a Taylor series, a network), the modes those of the
remainders and their sensitivities together, and :math:`c_k` a Gaussian process conditioned on
values *and* derivatives (:mod:`emulator.core.gaussian_process`). A run with its sensitivities
counts as p + 1 observations for a tenth more time.

A stationary kernel in theta fits badly where a body is stiff in one corner of the box and soft in
another. Its distance is therefore taken between features that contain some mechanics: theta's
position, and the leading coefficients of the Taylor series about the centre, which change fast
where the body is soft.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.gaussian_process import Features, fit_lengths, fit_weights, fold, mean
from emulator.core.machine import require_float64
from emulator.fem.campaign import Runs
from emulator.scenes.scene import Scene
from emulator.surrogates.part import ArrayPart, CachedPart
from emulator.surrogates.taylor import Expansion, monomials, rounded

Mean = Callable[[jax.Array], jax.Array]
"""A map from the position in the unit box (p,) to the displacement (n, 3) mm."""

# Weight of a sensitivity among the snapshots: a typical step as a fraction of the unit box.
_SENSITIVITY_WEIGHT = 0.3
_TRUNCATION = 1e-7  # relative to the largest singular value
_MOST_MODES = 96
# Largest numbers of modes and observations to which the lengths are fitted.
_FITTED_MODES = 20
_MOST_OBSERVATIONS = 500
_FEATURES = 4
_FEATURE_SAMPLES = 400


class Warp(NamedTuple):
    """The features of a position: itself and polynomials of it, each divided by its length.

    centre : the position about which the polynomials are taken, (p,).
    indices : the Taylor multi-indices of their terms, (t, o).
    coefficients : the coefficients of the terms, (t, f).
    inverse_lengths : the inverse length scales of all features, (p + f,).
    """

    centre: np.ndarray
    indices: np.ndarray
    coefficients: jax.Array
    inverse_lengths: jax.Array

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return the features (p + f,) of ``position`` (p,)."""
        polynomials = monomials(self.indices, position - self.centre) @ self.coefficients
        return jnp.concatenate([position, polynomials]) * self.inverse_lengths


@dataclass(frozen=True, eq=False)
class Discrepancy(ArrayPart):
    """The displacement to add to a map to meet FEM, a part of an emulator.

    warp : the features of a position.
    known : the features of the runs, (c, q).
    value_weights, derivative_weights : the weights (c, r) and (c, q, r) of the Gaussian processes,
        from :func:`~emulator.core.gaussian_process.fold`.
    offset, modes : the offset (n, 3) mm and the modes (r, n, 3) mm.
    """

    warp: Warp
    known: jax.Array
    value_weights: jax.Array
    derivative_weights: jax.Array
    offset: jax.Array
    modes: jax.Array

    def coefficients(self, position: jax.Array) -> jax.Array:
        """Return the coefficients (r,) of the modes at ``position`` (p,) in the unit box.

        In float32 it refuses: the weights of nearly equal runs are large and cancel, and the
        shipped ventricle would be 9 mm off.
        """
        require_float64("a discrepancy model")
        return mean(self.warp(position), self.known, self.value_weights, self.derivative_weights)

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return the displacement (n, 3) mm to add at ``position`` (p,)."""
        return self.offset + jnp.tensordot(self.coefficients(position), self.modes, axes=1)

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """Return the model over ``nodes`` (k,)."""
        offset, modes = np.asarray(self.offset)[nodes], np.asarray(self.modes)[:, nodes]
        return CachedPart(offset, modes, self.coefficients)

    def rounded(self) -> Discrepancy:
        """Return the model with offset and modes rounded to float32, for a smaller file."""
        return replace(self, offset=rounded(self.offset), modes=rounded(self.modes))


def fit_discrepancy(
    scene: Scene, runs: Runs, expansion: Expansion, mean_map: Mean | None = None
) -> Discrepancy:
    """Fit a discrepancy model to the differences of FEM ``runs`` from ``mean_map``.

    Parameters
    ----------
    scene, runs : the scene, and its FEM runs with sensitivities.
    expansion : the Taylor series whose leading coefficients are features of the kernel.
    mean_map : a differentiable approximation of FEM; ``None`` is zero.

    Raises
    ------
    InputError
        Fewer than two runs, runs without sensitivities or not finite, an expansion of another
        scene, or a map that leaves nothing to fit.
    """
    _check(scene, runs, expansion)
    positions = scene.to_unit(jnp.asarray(runs.theta))
    fields, sensitivities = _remainder(scene, runs, positions, mean_map)
    offset = fields.mean(axis=0)
    modes, observations = _project(fields - offset, sensitivities)
    warp = _warp(expansion, positions.shape[1])
    psi: Callable[[jax.Array], jax.Array] = warp.__call__
    features = Features(*jax.jit(jax.vmap(lambda x: (psi(x), jax.jacfwd(psi)(x))))(positions))
    lengths = _lengths(features, np.asarray(positions), observations)
    warp = warp._replace(inverse_lengths=lengths)
    scaled = features.scaled(lengths)
    values, folded = jax.jit(lambda f, y: fold(f, fit_weights(f, y)))(scaled, observations)
    nodal_modes = jnp.asarray(modes.reshape(-1, *offset.shape))
    return Discrepancy(warp, scaled.value, values, folded, jnp.asarray(offset), nodal_modes)


def _check(scene: Scene, runs: Runs, expansion: Expansion) -> None:
    count = len(runs.theta)
    if runs.sensitivities is None:
        raise InputError(
            f"a discrepancy model needs FEM runs with sensitivities; these {count} have none"
        )
    if count < 2:
        raise InputError(f"a discrepancy model needs 2 FEM runs or more; there is {count}")
    parameters = len(scene.parameters)
    if len(expansion.centre) != parameters:
        raise InputError(
            f"scene '{scene.name}' has {parameters} parameters; "
            f"the expansion is in {len(expansion.centre)}"
        )
    for what in ("theta", "displacement", "sensitivities"):
        finite = np.isfinite(np.asarray(getattr(runs, what))).reshape(count, -1).all(axis=1)
        if not finite.all():
            raise InputError(f"FEM run {int(np.argmin(finite))}: {what} not finite")


def _remainder(
    scene: Scene, runs: Runs, positions: jax.Array, mean_map: Mean | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return FEM minus ``mean_map``: fields (c, n, 3) and derivatives in position (c, p, n, 3)."""
    fields = np.asarray(runs.displacement)
    assert runs.sensitivities is not None, "checked above"
    derivatives = np.array(runs.sensitivities * scene.space.rates(runs.theta)[..., None, None])
    if mean_map is None:
        return fields, derivatives
    fields = fields - np.asarray(jax.jit(jax.vmap(mean_map))(positions))
    jacobian = jax.jit(jax.jacfwd(mean_map))
    for k, position in enumerate(positions):
        derivatives[k] -= np.moveaxis(np.asarray(jacobian(position)), -1, 0)
    if not (np.isfinite(fields).all() and np.isfinite(derivatives).all()):
        raise InputError(
            "a discrepancy model needs a map that is finite at every FEM run; this one is not"
        )
    return fields, derivatives


def _project(fields: np.ndarray, derivatives: np.ndarray) -> tuple[np.ndarray, jax.Array]:
    """Return modes (r, 3n) mm, and coefficients (c (1 + p), r) of fields and derivatives."""
    count, parameters = derivatives.shape[:2]
    fields, derivatives = fields.reshape(count, -1), derivatives.reshape(count, parameters, -1)
    weighted = _SENSITIVITY_WEIGHT * derivatives.reshape(count * parameters, -1)
    snapshots = np.concatenate([fields, weighted])
    most = min(_MOST_MODES, *snapshots.shape)
    from sklearn.utils.extmath import randomized_svd  # slow to import, and only for a fit

    _, size, right = randomized_svd(snapshots, most, n_iter=4, random_state=0)
    significant = size > max(_TRUNCATION * size[0], np.finfo(float).tiny)
    if not significant.any():
        raise InputError("a discrepancy model has nothing to fit: the map meets every FEM run")
    scale = size[significant] / np.sqrt(len(snapshots))
    both = np.concatenate([fields[:, None], derivatives], axis=1) @ (right[significant].T / scale)
    return right[significant] * scale[:, None], jnp.asarray(both.reshape(-1, significant.sum()))


def _lengths(features: Features, positions: np.ndarray, observations: jax.Array) -> jax.Array:
    """Return inverse lengths (q,) fitted to a subset of the runs and the leading modes."""
    per_run = 1 + positions.shape[1]
    subset = maximin_subset(positions, max(4, _MOST_OBSERVATIONS // per_run))
    rows = (subset[:, None] * per_run + np.arange(per_run)).ravel()
    some = Features(features.value[subset], features.derivative[subset])
    return jnp.asarray(fit_lengths(some, observations[rows][:, :_FITTED_MODES]))


def _warp(expansion: Expansion, parameters: int) -> Warp:
    """Return position, and the coefficients of the series' leading modes over the box."""
    centre, indices = expansion.centre, expansion.indices
    if not len(indices):
        return Warp(centre, indices, jnp.zeros((0, 0)), jnp.ones(parameters))
    derivatives = np.asarray(expansion.derivatives).reshape(len(indices), -1)
    samples = np.random.default_rng(0).random((_FEATURE_SAMPLES, parameters))
    weights = np.asarray(expansion.monomials(jnp.asarray(samples)))
    # Left singular vectors of the sampled fields, from the Gram matrix of the derivatives (t, t).
    values, vectors = np.linalg.eigh(derivatives @ derivatives.T)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    _, size, right = np.linalg.svd(weights @ root, full_matrices=False)
    count = min(_FEATURES, int(np.sum(size > 1e-6 * size[0])))
    coefficients = (root @ right[:count].T) / (size[:count] / np.sqrt(_FEATURE_SAMPLES))
    return Warp(centre, indices, jnp.asarray(coefficients), jnp.ones(parameters + count))


def maximin_subset(
    positions: np.ndarray, count: int, known: np.ndarray | None = None
) -> np.ndarray:
    """Return the rows of at most ``count`` different ``positions`` (c, p).

    Rows are chosen one after the other. Each is the farthest from its nearest neighbour among those
    chosen before and the ``known`` points (n, p).
    """
    subset = list[int]()
    distance = np.full(len(positions), np.inf)
    for point in () if known is None else known:
        distance = np.minimum(distance, np.sum((positions - point) ** 2, axis=1))
    while len(subset) < min(count, len(positions)) and distance.max() > 0.0:
        subset.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.sum((positions - positions[subset[-1]]) ** 2, axis=1))
    return np.array(subset, dtype=int)
