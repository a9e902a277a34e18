r"""Gaussian noise that correlates in space, at the cost of a rotation.

Data with independent errors and a Gaussian process over reference positions has the covariance

.. math:: C = \sigma^2 I + \omega^2 K, \qquad K_{jk} = k(|X_j - X_k| / \ell), \quad k(0) = 1.

With :math:`K = Q \Lambda Q^T`, computed once, :math:`C = Q (\sigma^2 I + \omega^2 \Lambda) Q^T`
for all sds: the rotated residual :math:`z = Q^T r` has independent entries of variance
:math:`\sigma^2 + \omega^2 \lambda_j`, and because :math:`|\det Q| = 1`

.. math:: \log p(r) = \sum_j \log \mathcal{N}(z_j;\; 0,\; \sigma^2 + \omega^2 \lambda_j).

A density costs one product with Q, O(d^2), where a Cholesky factor for every new
:math:`(\sigma, \omega)` would cost O(d^3) (Rasmussen and Williams 2006, Section 5.4, has the sums).

Leaving one datum out conditions it on all others, which takes the precision's diagonal and no other
factorisation (Sundararajan and Keerthi 2001; Bürkner, Gabry and Vehtari 2021). With
:math:`a = C^{-1} r` and :math:`c_j = (C^{-1})_{jj}`

.. math:: \log p(y_j \mid y_{-j}) = -\tfrac12 \log 2\pi + \tfrac12 \log c_j
          - \tfrac12\, a_j^2 / c_j .

Components of a vector or tensor do not correlate with one another; each has a K of its own, at the
positions where it was measured. Matérn's kernel of smoothness 3/2 is
:math:`k(s) = (1 + \sqrt3 s) e^{-\sqrt3 s}`, the squared exponential
:math:`k(s) = e^{-s^2/2}` (Rasmussen and Williams 2006, Equations 4.9 and 4.17).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import constraints
from numpyro.distributions.transforms import Transform
from scipy.spatial.distance import cdist

from calibrate.noise.protocol import Sites
from calibrate.noise.scale import check_positive
from emulator.core.errors import InputError, look_up

KERNELS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "matern32": lambda s: (1.0 + np.sqrt(3.0) * s) * np.exp(-np.sqrt(3.0) * s),
    "squared_exponential": lambda s: np.exp(-0.5 * s**2),
}
"""Correlation at distances in units of the correlation length."""


@dataclass(frozen=True, eq=False)
class SpatialModes:
    """Eigenvectors and eigenvalues of K, component by component.

    entries : of each component, its positions in the raveled data, (d_c,).
    vectors : of each component, (d_c, d_c), a mode a column.
    eigenvalues : (e,), in the order of the concatenated entries; none is negative.
    """

    entries: tuple[np.ndarray, ...]
    vectors: tuple[np.ndarray, ...]
    eigenvalues: np.ndarray

    def to_data(self, z: jax.Array) -> jax.Array:
        """Raveled data (..., e) from coordinates (..., e) along the modes."""
        parts = jnp.split(z, self._splits, axis=-1)
        rotated = [part @ Q.T for part, Q in zip(parts, self.vectors, strict=True)]
        return jnp.concatenate(rotated, axis=-1)[..., np.argsort(np.concatenate(self.entries))]

    def from_data(self, y: jax.Array) -> jax.Array:
        """Coordinates (..., e) along the modes; inverse of :meth:`to_data`."""
        parts = [y[..., k] @ Q for k, Q in zip(self.entries, self.vectors, strict=True)]
        return jnp.concatenate(parts, axis=-1)

    def diagonal(self, values: jax.Array) -> jax.Array:
        """Diagonal (e,) of Q diag(values) Q^T, in the order of the raveled data."""
        parts = zip(jnp.split(values, self._splits), self.vectors, strict=True)
        each = jnp.concatenate([Q**2 @ part for part, Q in parts])
        return each[np.argsort(np.concatenate(self.entries))]

    @property
    def _splits(self) -> list[int]:
        return np.cumsum([len(k) for k in self.entries])[:-1].tolist()


def spatial_modes(sites: Sites | None, length: float, kernel: str) -> SpatialModes:
    """Modes of the kernel with correlation length ``length`` (mm) at ``sites``.

    Raises
    ------
    InputError
        There are no sites.
    """
    if sites is None:
        raise InputError(
            "it correlates in space, but what is observed has no place of its own; "
            "use independent noise"
        )
    found: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
    entries = tuple(np.flatnonzero(sites.component == c) for c in np.unique(sites.component))
    for k in entries:
        points = sites.positions[k]
        if points.tobytes() not in found:
            values, Q = np.linalg.eigh(KERNELS[kernel](cdist(points, points) / length))
            found[points.tobytes()] = np.maximum(values, 0.0), Q  # less than 0 by round-off
    modes = [found[sites.positions[k].tobytes()] for k in entries]
    values = np.concatenate([values for values, _ in modes])
    return SpatialModes(entries, tuple(Q for _, Q in modes), values)


def check_kernel(length: float, kernel: str) -> None:
    """Raise :class:`InputError` on a length that is not above 0, or an unknown kernel."""
    check_positive("correlation length (mm)", length)
    look_up(KERNELS, kernel, "noise: kernel")


def spatial_distribution(
    modes: SpatialModes, mean: jax.Array, sd: float | jax.Array, spatial_sd: float | jax.Array
) -> dist.Distribution:
    """Gaussian with mean ``mean`` and covariance C of the module docstring, of ``mean``'s shape."""
    return SpatialNormal(modes, mean, jnp.sqrt(sd**2 + spatial_sd**2 * modes.eigenvalues))


def simulate(
    modes: SpatialModes, rng: np.random.Generator, sd: float, spatial_sd: float
) -> np.ndarray:
    """A draw (e,) of the noise, raveled."""
    sds = np.sqrt(sd**2 + spatial_sd**2 * modes.eigenvalues)
    return np.asarray(modes.to_data(jnp.asarray(rng.normal(0.0, sds))))


class SpatialNormal(dist.TransformedDistribution):
    """Gaussian around ``mean``, independent along the ``modes`` with these ``sds`` (e,)."""

    def __init__(self, modes: SpatialModes, mean: jax.Array, sds: jax.Array) -> None:
        self.modes, self.mean_, self.sds = modes, mean, sds
        super().__init__(dist.Normal(0.0, sds).to_event(1), _Rotated(modes, mean))

    def log_conditionals(self, value: jax.Array) -> jax.Array:
        """Log density of each number of ``value``, of the mean's shape, given all the others."""
        residual = (value - self.mean_).reshape(-1)
        precision = self.modes.diagonal(self.sds**-2)
        weighted = self.modes.to_data(self.modes.from_data(residual) / self.sds**2)
        each = 0.5 * (jnp.log(precision / (2.0 * jnp.pi)) - weighted**2 / precision)
        return each.reshape(self.mean_.shape)


class _Rotated(Transform):
    """From coordinates (..., e) along the modes to data (..., *shape) around a mean."""

    domain = constraints.real_vector

    def __init__(self, modes: SpatialModes, mean: jax.Array) -> None:
        self.modes, self.mean = modes, mean

    @property
    def codomain(self) -> Any:
        """Any data of the mean's shape."""
        return constraints.independent(constraints.real, self.mean.ndim)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Data around the mean."""
        return self.modes.to_data(x).reshape(*x.shape[:-1], *self.mean.shape) + self.mean

    def _inverse(self, y: jax.Array) -> jax.Array:
        batch = y.shape[: y.ndim - self.mean.ndim]
        return self.modes.from_data((y - self.mean).reshape(*batch, -1))

    def log_abs_det_jacobian(self, x: jax.Array, y: jax.Array, intermediates: Any = None) -> Any:
        """0: a rotation and a shift."""
        return jnp.zeros(x.shape[:-1])

    def forward_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Shape of data."""
        return (*shape[:-1], *self.mean.shape)

    def inverse_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Shape of coordinates along the modes."""
        return (*shape[: len(shape) - self.mean.ndim], len(self.modes.eigenvalues))

    def tree_flatten(self) -> Any:
        """The mean may be traced; the modes are constants."""
        return (self.mean,), (("mean",), {"modes": self.modes})
