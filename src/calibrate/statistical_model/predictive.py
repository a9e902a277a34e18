r"""The posterior density at any point, by the forward map alone and with a learned correction.

A certificate asks for the posterior where no draw is. In unconstrained coordinates :math:`z`
(:mod:`calibrate.statistical_model.density`) the log density is

.. math:: \log p(z) + \log p(y \mid g(\theta(z)) + d(\theta(z)))

with the prior and its Jacobian, the map's data without noise :math:`g`, and a correction :math:`d`,
which is zero for the map alone.

The correction is a Gaussian process of theta in the space of the data. At some theta FEM was
solved, and the map misses the data's means by :math:`D`. Between them

.. math:: d(x) = k(x, X) (k(X, X) + \tau^2 I)^{-1} D, \quad
    k(x, x') = v (1 + x \cdot x') + \exp(-|x - x'|^2 / 2 \ell^2)

for all data at once, with theta standardised, :math:`x`, and a linear trend of wide prior
:math:`v`. :math:`\ell` and :math:`\tau` minimise leave-one-out errors, which for a Gaussian
process have a closed form (Rasmussen and Williams 2006, Eq. 5.10-5.12). The size of these errors
also sets the scale :math:`a^2` of the process's variance, in squared noise sd,

.. math:: v(x) = a^2 (k(x, x) + \tau^2 - k(x, X) (k(X, X) + \tau^2 I)^{-1} k(X, x))

A wrong correction costs precision, not correctness: :math:`v` only says where to solve FEM next,
and FEM at fresh points tests what the correction predicts (:mod:`calibrate.certificate.check`). A
bump far from the posterior may spoil a process everywhere. So there are three candidates, a process
of all points, one of those that FEM finds likely, and none; leave-one-out errors at the likely ones
decide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.linalg import eigh

from calibrate.statistical_model.density import (
    BATCH,
    Density,
    density_of,
    finite_coordinates,
    in_blocks,
    prior_draws,
    without_nan,
)
from calibrate.statistical_model.model import Data, Model
from emulator.core.gaussian_process import Regression, squared_exponential

_LENGTHS = (0.25, 0.5, 1.0, 2.0, 4.0)  # correlation lengths that are compared, in sd of the points
_NUGGETS = (1e-6, 1e-4, 1e-2, 1.0, 1e2)
_TREND = 1e2
_NEGLIGIBLE = 1e-3  # leave-one-out error, in noise sd, that changes no posterior
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


class Correction(NamedTuple):
    r"""A fitted Gaussian process; all zeros for no correction.

    at : the features (n, q) of theta where FEM was solved, standardised; rows of zeros may be
        padding.
    weights : the weights of the kernel (n, m), zero in rows of padding.
    inverse : the inverse of the kernel matrix (n, n).
    centre, width : the mean and sd (q,) of the features, by which they are standardised.
    length, nugget, scale : :math:`\\ell`, :math:`\\tau^2` and :math:`a^2` of the kernel.
    local : whether it was fitted to likely points alone.
    """

    at: np.ndarray
    weights: np.ndarray
    inverse: np.ndarray
    centre: np.ndarray
    width: np.ndarray
    length: float
    nugget: float
    scale: float
    local: bool


def no_correction(rows: int, features: int, data: int) -> Correction:
    """Return the correction that is zero, of the shape of one fitted to ``rows`` points."""
    at, weights, inverse = (np.zeros((rows, width)) for width in (features, data, rows))
    centre, width = np.zeros(features), np.ones(features)
    return Correction(at, weights, inverse, centre, width, 1.0, 0.0, 0.0, local=False)


def _covariance(products: Any, squared: Any) -> Any:
    """Return k(x, x') from products of standardised features and squared distances in lengths."""
    return _TREND * (1.0 + products) + squared_exponential(squared)


def correct(correction: Correction, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the correction (m,) at features ``x`` (q,), and its variance in squared noise sd."""
    c = correction
    x = (x - c.centre) / c.width
    distance = jnp.sum((c.at - x) ** 2, axis=-1)
    kernel = _covariance(c.at @ x, distance / c.length**2)
    prior_variance = _TREND * (1.0 + x @ x) + 1.0 + c.nugget
    variance = c.scale * jnp.maximum(prior_variance - kernel @ c.inverse @ kernel, c.nugget)
    return kernel @ c.weights, variance


@jax.jit
def corrections(correction: Correction, x: jax.Array) -> jax.Array:
    """Return the correction (s, m) at features ``x`` (s, q)."""
    return jax.vmap(lambda row: correct(correction, row)[0])(x)


def fit_correction(
    x: np.ndarray,
    errors: np.ndarray,
    scales: np.ndarray,
    rows: int,
    likely: np.ndarray | None = None,
    like: Correction | None = None,
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
    """
    every = np.ones(len(x), dtype=bool)
    likely = every if likely is None or not likely.any() else likely
    parts, kernels = [every], list(product(_LENGTHS, _NUGGETS))
    # Precise data: the map misses far away by so much that errors near the posterior are hidden.
    if x.shape[1] + 2 <= likely.sum() < len(x):
        parts.append(likely)
    if like is not None and like.nugget > 0.0:
        parts, kernels = parts[-1:] if like.local else parts[:1], [(like.length, like.nugget)]
    squared_errors = np.mean((errors / scales) ** 2, axis=1)
    best = no_correction(rows, x.shape[1], errors.shape[1])._replace(
        scale=float(np.mean(squared_errors / (_TREND * (x**2).sum(axis=1) + _TREND + 1.0)))
    )
    smallest = np.log(squared_errors[likely] + _NEGLIGIBLE**2).mean()
    for used in parts:
        fitted, loss = _fitted(x[used], errors[used], scales, rows, likely[used], kernels)
        if loss < smallest:
            best, smallest = fitted._replace(local=used is not every), loss
    return best


def _fitted(
    x: np.ndarray,
    errors: np.ndarray,
    scales: np.ndarray,
    rows: int,
    likely: np.ndarray,
    kernels: list[tuple[float, float]],
) -> tuple[Correction, float]:
    """Return the process of these points, and the mean log of its errors where it is ``likely``."""
    width = x.std(axis=0)
    centre, width = x.mean(axis=0), np.where(width > 0.0, width, 1.0)
    x = (x - centre) / width
    fitted = no_correction(rows, x.shape[1], errors.shape[1])._replace(centre=centre, width=width)
    fitted.at[: len(x)] = x
    smallest, where_likely = np.inf, np.inf
    distances = ((x[:, None] - x) ** 2).sum(axis=-1)
    for length, nugget in kernels:
        kernel = _covariance(x @ x.T, distances / length**2) + nugget * np.eye(len(x))
        regression = Regression.of(kernel)
        inverse, weights = regression.inverse(), regression.weights(errors)
        # Leave-one-out errors in noise sd, and their variances up to a^2.
        variance = 1.0 / np.diag(inverse)
        square = np.mean((weights * variance[:, None] / scales) ** 2, axis=1)
        # Geometric mean over the points, so that the prior's corners do not decide.
        losses = np.log(square + _NEGLIGIBLE**2)
        if losses.mean() < smallest:
            smallest, where_likely = losses.mean(), losses[likely].mean()
            fitted.weights[: len(x)], fitted.inverse[: len(x), : len(x)] = weights, inverse
            scale = float(np.mean(square / variance))
            fitted = fitted._replace(length=length, nugget=nugget, scale=scale)
    return fitted, where_likely


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
    cheap : the likelihood that was sampled: the map's, widened for its error where the model is.
    corrected : the likelihood of the map with its correction, widened for the mesh's error only.
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

    def unconstrain(self, draws: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return z (s, p) of draws by name; a draw on a bound of its parameter is moved inside."""
        named = {name: jnp.asarray(draws[name]) for name in self.model.names}
        return finite_coordinates(jax.jit(jax.vmap(self._density.unconstrain))(named))

    def prior_draws(self, rng_key: jax.Array, count: int) -> np.ndarray:
        """Return points (count, p) drawn from the prior."""
        return prior_draws(self._density, rng_key, count)

    def by_map(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return ``prior``, ``cheap`` and ``means`` of :class:`Densities` at points (s, p)."""
        return in_blocks(self._map_block, z)

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

    @cached_property
    def prior_sd(self) -> np.ndarray:
        """Sd (p,) of the prior's z."""
        return self.prior_draws(jax.random.key(1), _WIDTH_DRAWS).std(axis=0)

    @_compiled
    def _curvature(self, z: jax.Array, means: jax.Array, slopes: jax.Array) -> Any:
        def likelihood(z: jax.Array, flat: jax.Array) -> jax.Array:
            draws = self._constrain(z)
            return self.model.fem_log_likelihood(draws, self.by_name(flat), self.data)

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
    def _scale_of_features(self) -> tuple[np.ndarray, np.ndarray]:
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
        centre, width = self._scale_of_features
        return (self._on_scales(draws) - centre) / width

    def _constrain(self, z: jax.Array) -> dict[str, jax.Array]:
        return jax.tree.map(lambda values: values[0], self._density.constrain(z[None]))

    def by_name(self, flat: jax.Array) -> dict[str, jax.Array]:
        """Return flat data (m,) by the observation's name."""
        shapes = self.model.observe.shapes
        return ravel_pytree({n: jnp.zeros(shape) for n, shape in shapes.items()})[1](flat)

    @_compiled
    def _map_block(self, z: jax.Array) -> Any:
        def one(z: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            draws = self._constrain(z)
            means, valid = self.model.predict(draws)
            cheap = self.model.map_log_likelihood(draws, self.data)
            flat = jnp.where(valid, ravel_pytree(means)[0], jnp.nan)
            cheap = without_nan(jnp.where(valid, cheap, -jnp.inf))
            return without_nan(self._density.log_prior(z)), cheap, flat

        return jax.lax.map(one, z, batch_size=BATCH)

    @_compiled
    def _correction_block(self, correction: Correction, z: jax.Array, means: jax.Array) -> Any:
        def one(point: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            draws = self._constrain(point[0])
            step, variance = correct(correction, self._features(draws))
            means = self.by_name(point[1] + step)
            return without_nan(self.model.fem_log_likelihood(draws, means, self.data)), variance

        return jax.lax.map(one, (z, means), batch_size=BATCH)
