r"""The posterior density at any point, by the forward map alone and with a learned correction.

A certificate asks for the posterior where no draw is. In unconstrained coordinates :math:`z`
(:mod:`calibrate.statistical_model.density`) the log density is

.. math:: \log p(z) + \log p(y \mid g(\theta(z)) + d(\theta(z)))

with the prior and its Jacobian, the map's data without noise :math:`g`, and a correction :math:`d`
(:mod:`emulator.surrogates.correction`), which is zero for the map alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.linalg import eigh

from calibrate.statistical_model.density import (
    Density,
    density_of,
    finite_coordinates,
    height_program,
    prior_draws,
    without_nan,
)
from calibrate.statistical_model.many_draws import BATCH, in_blocks
from calibrate.statistical_model.model import Data, Model
from emulator.surrogates.correction import Correction, correct, corrections

_WIDTH_DRAWS = 512  # draws of the prior, from which the scale of theta's features is taken


def noise_sds(model: Model, draws: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the sd of one number of each observation by noise, in its unit, by name.

    draws : draws (s,) by the unknown's name; an inferred sd is the median of its draws.
    """
    sites = model.noise_sites
    return {
        name: float(noise.size({s: jnp.median(draws[site]) for s, site in sites[name].items()}))
        for name, noise in model.noise.items()
    }


def gauss_newton_step(
    gradient: np.ndarray, curvature: np.ndarray, prior_sd: np.ndarray, longest: float = np.inf
) -> tuple[np.ndarray, float]:
    """Return the Gauss-Newton step (p,) up a log posterior, and its expected gain.

    gradient, curvature : as of :meth:`Predictive.curvature`.
    longest : the length to which the step is shortened, in sd of the prior.
    """
    values, vectors = eigh(curvature * prior_sd * prior_sd[:, None])
    # The prior's curvature is 1; where the likelihood is not concave, only the prior's is left.
    slope = vectors.T @ (gradient * prior_sd)
    along = slope / np.maximum(values, 1.0)
    length = float(np.linalg.norm(along))
    along *= min(1.0, longest / length) if length > 0.0 else 1.0
    return prior_sd * (vectors @ along), float(along @ slope - 0.5 * along @ (values * along))


class Densities(NamedTuple):
    """Log densities at points (s, p), each (s,), ``-inf`` where the density is zero.

    prior : the prior density of z, its Jacobian included.
    cheap : the likelihood that was sampled, the map's.
    corrected : the likelihood of the map with its correction.
    variance : the variance of the correction, in squared noise sd.
    means : the map's data without noise, flat (s, m); NaN where the map has no answer.
    """

    prior: Any
    cheap: Any
    corrected: Any
    variance: Any
    means: Any


def _compiled(method: Callable[..., Any]) -> Any:
    """Return the method as a program that each object compiles once."""
    return cached_property(lambda self: jax.jit(partial(method, self)))


@dataclass(frozen=True, eq=False)
class Predictive:
    """Prior, likelihoods and predictions of a model given its data, at points z (s, p).

    draws : draws (s,) of the posterior by name, of which noise that is inferred is taken.
    """

    model: Model
    data: Data
    draws: Mapping[str, np.ndarray] = field(default_factory=dict)

    @cached_property
    def _density(self) -> Density:
        return density_of(self.model)

    def constrain(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Return draws by name, each (s,)."""
        return in_blocks(self._density.constrain, z)

    def columns(self, z: np.ndarray) -> np.ndarray:
        """Return draws (s, p) of the model's unknowns, in the order of their names."""
        draws = self.constrain(z)
        return np.stack([draws[name] for name in self.model.names], axis=1)

    def on_scales(self, columns: np.ndarray) -> np.ndarray:
        """Return :meth:`columns` (s, p), theta's unknowns on their parameters' scales."""
        count = len(self.model.states.unknowns)
        theta = np.asarray(self.model.on_scales(columns[:, :count]))
        return np.concatenate([theta, columns[:, count:]], axis=1)

    def unconstrain(self, draws: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return z (s, p) of draws by name; a draw on a bound of its parameter is moved inside."""
        named = {name: jnp.asarray(draws[name]) for name in self.model.names}
        return finite_coordinates(jax.jit(jax.vmap(self._density.unconstrain))(named))

    def prior_draws(self, rng_key: jax.Array, count: int) -> np.ndarray:
        """Return points (count, p) drawn from the prior."""
        return prior_draws(self._density, rng_key, count)

    def by_map(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return ``prior``, ``cheap`` and ``means`` of :class:`Densities` at points (s, p)."""

        def block(z: jax.Array) -> tuple[jax.Array, jax.Array, np.ndarray]:
            means, valid = self._density.means(z)
            at = height_program(self._density)(z, means, valid, self.data)
            # In the order of ravel_pytree.
            flat = np.concatenate([m.reshape(len(m), -1) for m in jax.tree.leaves(means)], axis=1)
            return at.prior, at.likelihood, np.where(valid[:, None], flat, np.nan)

        return in_blocks(block, z)

    def evaluate(self, z: np.ndarray, correction: Correction) -> Densities:
        """Return log densities at points (s, p)."""
        prior, cheap, means = self.by_map(z)
        unknown = np.full(len(z), -np.inf)
        at = Densities(prior, cheap, unknown, unknown, means)
        return self.evaluate_again(z, at, correction)

    def evaluate_again(self, z: np.ndarray, at: Densities, correction: Correction) -> Densities:
        """Return ``at``, of ``z`` (s, p), under another correction; the map is not asked again."""
        program = partial(self._correction_block, correction)
        corrected, variance = in_blocks(program, z, at.means)
        return at._replace(corrected=corrected, variance=variance)

    def means(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the map's data without noise, flat (s, m), and whether it has an answer (s,)."""
        means = self.by_map(z)[2]
        valid = np.isfinite(means).all(axis=1)
        return np.where(valid[:, None], means, 0.0), valid

    def corrected_means(self, z: np.ndarray, correction: Correction) -> np.ndarray:
        """Return the corrected map's data without noise, flat (s, m)."""
        return self.means(z)[0] + np.asarray(corrections(correction, self.features(z)))

    def curvature(
        self, z: np.ndarray, means: np.ndarray, slopes: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        r"""Return the log prior, and gradient (p,) and curvature (p, p) of FEM's log posterior.

        .. math::
            \nabla \log\pi = J^T \nabla_m \ell + \partial_z \ell + \nabla \log p, \qquad
            H = -J^T \nabla_m^2 \ell\, J + \operatorname{diag}(s^{-2})

        with the log likelihood :math:`\ell` of FEM's means :math:`m`, their derivatives :math:`J`
        in z, and the prior's sd :math:`s` (Gauss-Newton).

        Parameters
        ----------
        z : the point (p,). means : FEM's data without noise there, flat (m,).
        slopes : derivatives (m, S, p) of ``means`` in the theta of each load state.
        """
        prior, gradient, curvature = self._curvature(z, means, slopes)
        curvature = np.asarray(curvature) + np.diag(self.prior_sd**-2)
        return float(prior), np.asarray(gradient), curvature

    def slopes(self, z: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, S, p) of the map's flat data in theta, at z (p,)."""
        return np.asarray(self._slopes(z))

    @_compiled
    def _slopes(self, z: jax.Array) -> jax.Array:
        def means(thetas: jax.Array) -> jax.Array:
            return ravel_pytree(self.model.means(thetas)[0])[0]

        return jax.jacfwd(means)(self.model.states.thetas(self._constrain(z)))

    def error_slopes(self, z: np.ndarray, of_fem: np.ndarray) -> np.ndarray:
        """Return the derivatives (q, m) in the features, at z (p,), of FEM's data less the map's.

        of_fem : derivatives (m, S, p) of FEM's data in the theta of each load state.
        """
        of_map, of_thetas = self._feature_slopes(z)
        return np.tensordot(of_thetas, of_fem, axes=([0, 1], [1, 2])) - of_map

    @_compiled
    def _feature_slopes(self, z: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the derivatives in the features: of the map's data (q, m), of theta (S, p, q)."""
        centre, width = self.scale_of_features

        def thetas(x: jax.Array) -> jax.Array:
            values = self.model.from_scales(centre + width * x)
            return self.model.states.thetas(
                dict(zip(self.model.states.unknowns, values, strict=True))
            )

        x = self._features(self._constrain(z))
        of_data = jax.jacfwd(lambda x: ravel_pytree(self.model.means(thetas(x))[0])[0])(x)
        return of_data.T, jax.jacfwd(thetas)(x)

    @cached_property
    def prior_sd(self) -> np.ndarray:
        """Sd (p,) of the prior's z."""
        return self.prior_draws(jax.random.key(1), _WIDTH_DRAWS).std(axis=0)

    @_compiled
    def _curvature(self, z: jax.Array, means: jax.Array, slopes: jax.Array) -> Any:
        def likelihood(z: jax.Array, flat: jax.Array) -> jax.Array:
            draws = self._constrain(z)
            return self.model.log_likelihood(draws, self.model.observe.unravel(flat), self.data)

        J = jax.jacfwd(lambda z: self.model.states.thetas(self._constrain(z)))(z)
        J = jnp.tensordot(slopes, J, axes=2)
        in_z, in_means = jax.grad(likelihood, argnums=(0, 1))(z, means)
        second = jax.hessian(likelihood, argnums=1)(z, means)
        prior, in_prior = jax.value_and_grad(self._density.log_prior)(z)
        return prior, J.T @ in_means + in_z + in_prior, -J.T @ second @ J

    def features(self, z: np.ndarray) -> np.ndarray:
        """Return the unknowns (s, q) of theta on their parameters' scales, standardised."""
        return np.asarray(self._features(self.constrain(z)))

    @cached_property
    def scales(self) -> np.ndarray:
        """Noise sd (m,) of each of the flat data, in its unit."""
        sds = noise_sds(self.model, self.draws)
        levels = {n: np.full(shape, sds[n]) for n, shape in self.model.observe.shapes.items()}
        return np.asarray(ravel_pytree(levels)[0])

    @cached_property
    def scale_of_features(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd (q,) over the prior of theta's unknowns on their parameters' scales."""
        with jax.ensure_compile_time_eval():
            draws = jax.jit(lambda key: self._on_scales(self.model.prior_draws(key, _WIDTH_DRAWS)))
            x = np.asarray(draws(jax.random.key(0)))
        return x.mean(axis=0), x.std(axis=0)

    def _on_scales(self, draws: Mapping[str, jax.Array]) -> jax.Array:
        """Return the unknowns (..., q) of theta on their parameters' scales."""
        columns = [draws[name] for name in self.model.states.unknowns]
        return self.model.on_scales(jnp.stack(columns, axis=-1))

    @_compiled
    def _features(self, draws: Mapping[str, jax.Array]) -> jax.Array:
        centre, width = self.scale_of_features
        return (self._on_scales(draws) - centre) / width

    def _constrain(self, z: jax.Array) -> dict[str, jax.Array]:
        return jax.tree.map(lambda values: values[0], self._density.constrain(z[None]))

    @_compiled
    def _correction_block(self, correction: Correction, z: jax.Array, means: jax.Array) -> Any:
        def one(point: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            draws = self._constrain(point[0])
            step, variance = correct(correction, self._features(draws))
            means = self.model.observe.unravel(point[1] + step)
            return without_nan(self.model.log_likelihood(draws, means, self.data)), variance

        return jax.lax.map(one, (z, means), batch_size=BATCH)
