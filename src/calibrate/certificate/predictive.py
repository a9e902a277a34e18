r"""Densities of a posterior at any point of unconstrained coordinates, with and without correction.

A certificate asks for the posterior where no draw is. In coordinates :math:`z` (NumPyro's, see
:mod:`calibrate.samplers.density`) the log density is the sum of

.. math:: \log p(z) + \log p(y \mid g(\theta(z)) + d(\theta(z)))

the prior with its Jacobian and the likelihood of the forward map's data without noise, :math:`g`,
plus a correction :math:`d` (:mod:`calibrate.certificate.correction`). The map alone has
:math:`d = 0`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.certificate.correction import Correction, correct, corrections, nothing
from calibrate.samplers.density import Density, density_of
from calibrate.statistical_model import Data, Model

_BLOCK = 256  # points evaluated by one call of a program, so that it is compiled for one shape
_BATCH = 32  # of them side by side
_FARTHEST = 40.0  # |z| at which a bounded parameter is its bound in double precision
_WIDTH_DRAWS = 512  # of the prior, from which the scale of theta's features is taken


class Evaluated(NamedTuple):
    """Log densities at points (s, p): each (s,), ``-inf`` where there is none.

    prior : of z, its Jacobian included.
    cheap : likelihood that the draws are from: the map's, with what is allowed for its error.
    corrected : likelihood of the map with its correction, and nothing allowed but for the mesh.
    variance : of the correction, in squared noise sd.
    means : the map's data without noise, flat (s, m); NaN where it has no answer.
    """

    prior: Any
    cheap: Any
    corrected: Any
    variance: Any
    means: Any


@dataclass(frozen=True, eq=False)
class Predictive:
    """Prior, likelihoods and predictions of a model given its data, at points z (s, p)."""

    model: Model
    data: Data

    @cached_property
    def _density(self) -> Density:
        return density_of(self.model)

    @property
    def dimension(self) -> int:
        """Number of unconstrained coordinates."""
        return self._density.dimension

    def constrain(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Draws by name, each (s,)."""
        return self._in_blocks(self._density.constrain, z)

    def unconstrain(self, draws: Mapping[str, np.ndarray]) -> np.ndarray:
        """Z (s, p) of draws by name; a draw on a bound of its parameter is moved inside."""
        named = {name: jnp.asarray(draws[name]) for name in self.model.names}
        return _inside(jax.jit(jax.vmap(self._density.unconstrain))(named))

    def prior_draws(self, rng_key: jax.Array, count: int) -> np.ndarray:
        """Points (count, p) from the prior."""
        return _inside(self._prior_draws(jax.random.split(rng_key, count)))

    @cached_property
    def uncorrected(self) -> Correction:
        """The correction of this model's data that is zero."""
        return nothing(1, len(self.model.states.unknowns), len(self.scales))

    def evaluate(self, z: np.ndarray, correction: Correction) -> Evaluated:
        """Log densities at points (s, p)."""
        prior, cheap, means = self._in_blocks(self._map_block, z)
        nothing_yet = np.full(len(z), -np.inf)
        at = Evaluated(prior, cheap, nothing_yet, nothing_yet, means)
        return self.evaluate_again(z, at, correction)

    def evaluate_again(self, z: np.ndarray, at: Evaluated, correction: Correction) -> Evaluated:
        """``at`` of the points (s, p) under another correction; the map is not asked again."""

        def block(points: jax.Array, means: jax.Array) -> tuple[jax.Array, jax.Array]:
            return self._correction_block(points, means, correction)

        corrected, variance = self._in_blocks(block, z, at.means)
        return at._replace(corrected=corrected, variance=variance)

    def means(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The map's data without noise, flat (s, m), and whether it has an answer (s,)."""
        means = self._in_blocks(self._map_block, z)[2]
        valid = np.isfinite(means).all(axis=1)
        return np.where(valid[:, None], means, 0.0), valid

    def corrected_means(self, z: np.ndarray, correction: Correction) -> np.ndarray:
        """The corrected map's data without noise, flat (s, m)."""
        features, means = self.features(z), self.means(z)[0]
        return means + np.asarray(corrections(correction, features))

    def curvature(
        self, z: np.ndarray, means: np.ndarray, slopes: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        r"""Log prior at ``z`` (p,); of FEM's log posterior, the gradient (p,), minus the curvature.

        .. math::
            \nabla \log\pi = J^T \nabla_m \ell + \partial_z \ell + \nabla \log p, \qquad
            H = -J^T \nabla_m^2 \ell\, J + \operatorname{diag}(s^{-2})

        (Gauss-Newton), with :math:`\ell` the log likelihood of FEM's means :math:`m` (m,), their
        derivatives in ``z``, :math:`J`, by ``slopes`` (m, S, p), and the prior's sd :math:`s`.
        """
        prior, gradient, curvature = self._curvature(z, means, slopes)
        curvature = np.asarray(curvature) + np.diag(self.prior_sd**-2)
        return float(prior), np.asarray(gradient), curvature

    @cached_property
    def prior_sd(self) -> np.ndarray:
        """Sd (p,) of the prior's z."""
        return self.prior_draws(jax.random.key(1), _WIDTH_DRAWS).std(axis=0)

    @cached_property
    def _curvature(self) -> Any:
        def told(z: jax.Array, means: jax.Array, slopes: jax.Array) -> tuple[jax.Array, ...]:
            def likelihood(at: jax.Array, flat: jax.Array) -> jax.Array:
                draws = self._constrain(at)
                return self.model.fem_log_likelihood(draws, self.by_name(flat), self.data)

            def thetas(at: jax.Array) -> jax.Array:
                return self.model.states.thetas(self._constrain(at))

            J = jnp.tensordot(slopes, jax.jacfwd(thetas)(z), axes=2)
            in_z, in_means = jax.grad(likelihood, argnums=(0, 1))(z, means)
            second = jax.hessian(likelihood, argnums=1)(z, means)
            prior, in_prior = jax.value_and_grad(self._density.log_prior)(z)
            return prior, J.T @ in_means + in_z + in_prior, -J.T @ second @ J

        return jax.jit(told)

    def features(self, z: np.ndarray) -> np.ndarray:
        """Unknowns of theta (s, q) on their parameters' scales, standardised by the prior."""
        draws = self.constrain(z)
        return np.asarray(self._compiled_features(draws))

    @cached_property
    def scales(self) -> np.ndarray:
        """Noise level of each of the flat data, (m,), in its unit."""
        levels = {
            name: np.full(part.shape, self.model.noise[name].upper_sd)
            for name, part in self.model.observe.parts.items()
        }
        return np.asarray(ravel_pytree(levels)[0])

    @cached_property
    def _scale_of_features(self) -> tuple[np.ndarray, np.ndarray]:
        with jax.ensure_compile_time_eval():
            key = jax.random.key(0)
            x = np.asarray(
                jax.jit(lambda key: self._on_scales(self.model.prior_draws(key, _WIDTH_DRAWS)))(key)
            )
        return x.mean(axis=0), x.std(axis=0)

    def _on_scales(self, draws: Mapping[str, jax.Array]) -> jax.Array:
        """Unknowns of theta (..., q), as logarithms where their parameter's scale is ``log``."""
        columns = [
            jnp.log(draws[name]) if log else draws[name]
            for name, log in zip(self.model.states.unknowns, self.model.on_log_scale, strict=True)
        ]
        return jnp.stack(columns, axis=-1)

    def _features(self, draws: Mapping[str, jax.Array]) -> jax.Array:
        centre, width = self._scale_of_features
        return (self._on_scales(draws) - centre) / width

    @cached_property
    def _compiled_features(self) -> Any:
        return jax.jit(self._features)

    def _constrain(self, z: jax.Array) -> dict[str, jax.Array]:
        return jax.tree.map(lambda values: values[0], self._density.constrain(z[None]))

    def _by_map(self, z: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Log prior and likelihood, and the data without noise, flat (m,)."""
        draws = self._constrain(z)
        means, valid = self.model.predict(draws)
        cheap = self.model.map_log_likelihood(draws, self.data)
        flat = jnp.where(valid, ravel_pytree(means)[0], jnp.nan)
        return (
            _finite(self._density.log_prior(z)),
            _finite(jnp.where(valid, cheap, -jnp.inf)),
            flat,
        )

    def _by_correction(
        self, z: jax.Array, flat: jax.Array, correction: Correction
    ) -> tuple[jax.Array, jax.Array]:
        """Log likelihood of the map's data ``flat`` (m,) corrected, and the variance of that."""
        draws = self._constrain(z)
        step, variance = correct(correction, self._features(draws))
        moved = self.by_name(flat + step)
        return _finite(self.model.fem_log_likelihood(draws, moved, self.data)), variance

    def by_name(self, flat: jax.Array) -> dict[str, jax.Array]:
        """Data by name from flat ones (m,)."""
        parts = self.model.observe.parts
        return ravel_pytree({name: jnp.zeros(parts[name].shape) for name in parts})[1](flat)

    @cached_property
    def _map_block(self) -> Any:
        return jax.jit(lambda z: jax.lax.map(self._by_map, z, batch_size=_BATCH))

    @cached_property
    def _correction_block(self) -> Any:
        def block(z: jax.Array, means: jax.Array, correction: Correction) -> Any:
            def one(x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
                return self._by_correction(*x, correction)

            return jax.lax.map(one, (z, means), batch_size=_BATCH)

        return jax.jit(block)

    @cached_property
    def _prior_draws(self) -> Any:
        return jax.jit(jax.vmap(self._density.prior_draw))

    def _in_blocks(self, program: Any, *points: np.ndarray) -> Any:
        """``program`` of arrays (s, ...), in blocks of one shape; the last one is filled up."""
        count = len(points[0])
        padded = [np.concatenate([x, np.repeat(x[-1:], -count % _BLOCK, axis=0)]) for x in points]
        parts = [
            jax.tree.map(np.asarray, program(*(jnp.asarray(x[k : k + _BLOCK]) for x in padded)))
            for k in range(0, len(padded[0]), _BLOCK)
        ]
        return jax.tree.map(lambda *arrays: np.concatenate(arrays)[:count], *parts)


def _finite(log_density: jax.Array) -> jax.Array:
    """``-inf`` where it is not a number."""
    return jnp.where(jnp.isfinite(log_density), log_density, -jnp.inf)


def _inside(z: jax.Array) -> np.ndarray:
    """Points whose coordinates are finite: a draw on a bound is at infinity."""
    return np.clip(np.nan_to_num(np.asarray(z), posinf=1e9, neginf=-1e9), -_FARTHEST, _FARTHEST)
