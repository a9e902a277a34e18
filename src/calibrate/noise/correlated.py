r"""Gaussian noise of which a part correlates in space, at the cost of a rotation.

Registration and tracking err alike in neighbouring points, and a model that is wrong is wrong alike
in them. Data with independent errors and a Gaussian process over reference positions have the
covariance

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

Where the process is the discrepancy of a model (Kennedy and O'Hagan 2001, Equation 5, with scale
factor 1), its sd is inferred. Data alone cannot tell a discrepancy from a change of theta that
looks the same (Brynjarsdóttir and O'Hagan 2014): a mean of zero and a length that is given keep it
from taking all shapes and sizes. The posterior of theta widens; it does not become right by itself.

Components of a vector or tensor do not correlate with one another; each has a K of its own, at the
positions where it was measured. The kernels k are those of :mod:`emulator.core.gaussian_process`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import constraints
from scipy.spatial.distance import cdist

from calibrate.noise.gaussian import independent_sd
from calibrate.noise.protocol import Noise, Scale, Sites, check_positive
from emulator.core.errors import InputError, look_up
from emulator.core.gaussian_process import CORRELATIONS


@dataclass(frozen=True, eq=False)
class SpatialModes:
    """Eigenvectors and eigenvalues of K, component by component.

    entries : the positions of each component in the raveled data, (d_c,).
    vectors : the eigenvectors of each component as columns, (d_c, d_c).
    eigenvalues : all eigenvalues in the order of the concatenated entries, (e,); none is negative.
    """

    entries: tuple[np.ndarray, ...]
    vectors: tuple[np.ndarray, ...]
    eigenvalues: np.ndarray

    @classmethod
    def of(cls, sites: Sites | None, length: float, kernel: str) -> SpatialModes:
        """Return the modes of a kernel with correlation length ``length`` (mm) at ``sites``."""
        if sites is None:
            raise InputError(
                "it correlates in space, but what is observed has no place of its own; "
                "use independent noise"
            )
        entries = tuple(np.flatnonzero(sites.component == c) for c in np.unique(sites.component))

        @cache  # components are seen at the same points, unless values are missing
        def decomposed(points: bytes) -> tuple[np.ndarray, np.ndarray]:
            X = np.frombuffer(points).reshape(-1, 3)
            K = CORRELATIONS[kernel](cdist(X, X, "sqeuclidean") / length**2)
            eigenvalues, Q = np.linalg.eigh(K)
            return np.maximum(eigenvalues, 0.0), Q  # round-off may be below 0

        modes = [decomposed(sites.positions[k].astype(float).tobytes()) for k in entries]
        return cls(entries, tuple(Q for _, Q in modes), np.concatenate([v for v, _ in modes]))

    def to_data(self, z: jax.Array) -> jax.Array:
        """Return raveled data (..., e) from coordinates (..., e) along the modes."""
        parts = jnp.split(z, self._splits, axis=-1)
        rotated = [part @ Q.T for part, Q in zip(parts, self.vectors, strict=True)]
        return jnp.concatenate(rotated, axis=-1)[..., self._order]

    def from_data(self, y: jax.Array) -> jax.Array:
        """Return coordinates (..., e) along the modes; the inverse of :meth:`to_data`."""
        parts = [y[..., k] @ Q for k, Q in zip(self.entries, self.vectors, strict=True)]
        return jnp.concatenate(parts, axis=-1)

    def diagonal(self, values: jax.Array) -> jax.Array:
        """Return the diagonal (e,) of Q diag(values) Q^T, in the order of the raveled data."""
        parts = zip(jnp.split(values, self._splits), self.vectors, strict=True)
        return jnp.concatenate([Q**2 @ part for part, Q in parts])[self._order]

    @property
    def _splits(self) -> list[int]:
        return np.cumsum([len(k) for k in self.entries])[:-1].tolist()

    @property
    def _order(self) -> np.ndarray:
        return np.argsort(np.concatenate(self.entries))


class SpatialNormal(dist.Distribution):
    """Gaussian around ``mean``, independent along the ``modes`` with these ``sds`` (e,)."""

    arg_constraints: dict = {}  # noqa: RUF012
    pytree_data_fields = ("centre", "sds")
    pytree_aux_fields = ("modes",)

    def __init__(self, modes: SpatialModes, mean: jax.Array, sds: jax.Array) -> None:
        self.modes, self.centre, self.sds = modes, mean, sds
        super().__init__(batch_shape=(), event_shape=mean.shape)

    @property
    def support(self) -> constraints.Constraint:
        """Any data of the mean's shape."""
        return constraints.independent(constraints.real, self.centre.ndim)

    def log_prob(self, value: jax.Array) -> jax.Array:
        """Return the log density of data (..., *shape)."""
        batch = value.shape[: value.ndim - self.centre.ndim]
        z = self.modes.from_data((value - self.centre).reshape(*batch, -1))
        return dist.Normal(0.0, self.sds).to_event(1).log_prob(z)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Return draws (*sample_shape, *shape)."""
        z = dist.Normal(0.0, self.sds).sample(key, sample_shape)
        return self.modes.to_data(z).reshape(*sample_shape, *self.centre.shape) + self.centre

    def log_conditionals(self, value: jax.Array) -> jax.Array:
        """Return the log density of each number of ``value`` given all the others."""
        residual = (value - self.centre).reshape(-1)
        precision = self.modes.diagonal(self.sds**-2)
        weighted = self.modes.to_data(self.modes.from_data(residual) / self.sds**2)
        log_densities = 0.5 * (jnp.log(precision / (2.0 * jnp.pi)) - weighted**2 / precision)
        return log_densities.reshape(self.centre.shape)


@dataclass(frozen=True)
class CorrelatedNoise(Noise):
    r"""Noise of covariance :math:`\sigma^2 I + \omega^2 K`, in the observation's unit.

    length : the known correlation length over reference positions, mm.
    sd, sd_scale : the standard deviation of the independent part, or the scale of its half-normal
        prior.
    spatial_sd, spatial_sd_scale : the same for the part that correlates.
    kernel : the kernel, a name of :data:`emulator.core.gaussian_process.CORRELATIONS`.
    sites : the sites at which the data was measured; a model sets them.
    """

    length: float
    sd: float | None = None
    sd_scale: float | None = None
    spatial_sd: float | None = None
    spatial_sd_scale: float | None = None
    kernel: str = "matern32"
    sites: Sites | None = field(default=None, compare=False, repr=False)

    kind: ClassVar[str] = "correlated"

    def __post_init__(self) -> None:
        check_positive("correlation length (mm)", self.length)
        look_up(CORRELATIONS, self.kernel, "kernel")
        super().__post_init__()

    @property
    def spatial(self) -> Scale:
        """Standard deviation of the part that correlates."""
        options = ("spatial_sd", "spatial_sd_scale")
        return Scale("spatial_sd", options, self.spatial_sd, self.spatial_sd_scale)

    @property
    def scales(self) -> tuple[Scale, ...]:
        """The standard deviations sigma and omega."""
        return independent_sd(self.sd, self.sd_scale), self.spatial

    @cached_property
    def modes(self) -> SpatialModes:
        """Modes of the kernel at the sites; :class:`InputError` where there are none."""
        return SpatialModes.of(self.sites, self.length, self.kernel)

    @property
    def upper_sd(self) -> float:
        """Largest plausible sd along a mode."""
        independent, spatial = (scale.upper for scale in self.scales)
        return float(np.sqrt(independent**2 + spatial**2 * self.modes.eigenvalues.max()))

    def at(self, sites: Sites | None) -> Self:
        """Return the noise of data measured at ``sites``; :class:`InputError` without sites."""
        bound = replace(self, sites=sites)
        bound.modes  # noqa: B018 - computed once, and refused here without sites
        return bound

    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Return the Gaussian around ``mean``, the part that correlates integrated out."""
        return SpatialNormal(self.modes, mean, jnp.sqrt(self._variances(values)))

    def information(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> jax.Array:
        """Return the inverse of the covariance, (d, d)."""
        rotation = self.modes.from_data(jnp.eye(mean.size))
        return self.modes.to_data(rotation / self._variances(values))

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Return noise of data of this shape; :class:`InputError` where an sd is not known."""
        sds = np.sqrt(self._variances({s.name: s.needed() for s in self.scales}))
        return np.asarray(self.modes.to_data(jnp.asarray(rng.normal(0.0, sds)))).reshape(shape)

    def _variances(self, values: Mapping[str, Any]) -> Any:
        """Return the variances along the modes, (e,)."""
        independent, spatial = (scale.value(values) for scale in self.scales)
        return independent**2 + spatial**2 * self.modes.eigenvalues
