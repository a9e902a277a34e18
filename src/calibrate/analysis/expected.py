r"""What data would determine, before there is any: posteriors of data that the prior expects.

For each of some draws of the prior data is made, :math:`y_r \sim p(y \mid x_r)`, and the covariance
of its posterior :math:`p(x \mid y_r)` is found by importance sampling, from draws of the prior and
of a Student's t about a Newton step from :math:`x_r`,

.. math:: w_i \propto \frac{p(x_i)\, p(y_r \mid x_i)}
                           {\beta\, p(x_i) + (1 - \beta)\, t_5(x_i;\, \hat x, Q)},
          \qquad Q = (F + P^{-1})^{-1},

with the Fisher information F of :mod:`~calibrate.analysis.fisher`, the prior's
covariance P and the share :math:`\beta` of draws from the prior; :math:`\hat x` and Q are
then those of the weighted draws, and it is done again (Cappe et al. 2008; Owen and Zhou 2000).
If too few draws carry the weight, the covariance is Q. Posteriors are
averaged, not informations: by Jensen's inequality the inverse of a mean information is less than
the mean posterior covariance, and a box of a prior ends where a Gaussian does not.
:math:`x = \log\theta` where all unknowns are positive, else :math:`\theta`.

Errors that many numbers share are in the data and in :math:`p(y \mid x)`, which marginalises them
(:mod:`~calibrate.analysis.fisher`). Where the size of one is inferred, each
data set has another quantile of its prior, and F is that of x at this size: about x and
the size together Gaussian data has no information in common, so that not to know
the size widens x in second order only.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import gammaln

from calibrate.analysis.fisher import Errors, information_at, log_ratio, of_each, sizes_of
from calibrate.analysis.identifiability import combinations, prior_table
from calibrate.model_error.marginal import ModelError
from calibrate.statistical_model import Model
from calibrate.statistical_model.errors import errors_of_data
from emulator.core.errors import InputError

_DATA_SETS = 64
_FROM_PRIOR = 3072  # draws of the prior that all data sets share
_AROUND = 512  # draws of Student's t for each data set
_ROUNDS = 2  # fits of Student's t to the draws before
_BATCH = 128
_EFFECTIVE = 30.0  # effective draws; below, the covariance of the linear map and a normal prior
_DOF = 5.0
_WIDER = 1.3  # factor by which Student's t is wider than the estimated covariance


def expected_precision(
    model: Model,
    at: Mapping[str, float] | None = None,
    *,
    systematic: Mapping[str, Mapping[str, Any]] | None = None,
    data_sets: int = _DATA_SETS,
    seed: int = 0,
) -> dict[str, Any]:
    """Return what ``model``'s observations would determine, before any data; plain JSON.

    Parameters
    ----------
    at : the unknowns by name at which the map is linearised, with a normal prior; by default the
        posteriors of ``data_sets`` data sets, made at draws of the prior, are averaged.
    systematic : errors that many numbers share, by name, as in an experiment file
        (:mod:`~calibrate.model_error.kinds`), made for each data set. Those of
        :func:`calibrate.with_systematic` are the model's already, the same for all data.

    Returns
    -------
    sd : the expected posterior sd of each unknown relative to the prior's, in log theta where all
        unknowns are positive.
    combinations : the combinations of :func:`~calibrate.analysis.identifiability.identify` that
        the data would inform, from the mean posterior covariance; empty where an unknown may be 0
        or below.

    Raises
    ------
    InputError
        The forward map has no answer at any of the draws, noise has no known sd, or an error that
        does not fit.
    """
    if any(model.noise_sites.values()):
        raise InputError(
            "identifiability: give every noise a known sd, as in GaussianNoise(sd=...)"
        )
    errors: Errors = errors_of_data(model, systematic) if systematic else lambda _: model.error
    names, prior = model.states.unknowns, prior_table(model)
    log = bool((prior > 0.0).all())
    before = np.atleast_2d(np.cov(np.log(prior) if log else prior, rowvar=False))
    if at is None:
        covariances = _posterior_covariances(model, errors, prior, before, data_sets, seed, log=log)
    else:
        information = _informations(model, errors, np.array([at[name] for name in names]), log=log)
        covariances = np.linalg.inv(information + np.linalg.inv(before))
    sd = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)).mean(axis=0)
    ratio = sd / np.sqrt(np.diagonal(before))
    many = sum(int(np.prod(part.shape)) for part in model.observe.parts.values())
    best = combinations(names, covariances.mean(axis=0), before)[:many] if log else []
    return {"sd": dict(zip(names, ratio.tolist(), strict=True)), "combinations": best}


class _Around(NamedTuple):
    """Student's t: its centre (q,) and the Cholesky factor (q, q) of its scale matrix."""

    centre: jax.Array
    root: jax.Array

    def draw(self, key: jax.Array, count: int) -> jax.Array:
        """Return draws (count, q)."""
        normal, chi2 = jax.random.split(key)
        q = len(self.centre)
        z = jax.random.normal(normal, (count, q))
        g = jax.random.chisquare(chi2, _DOF, (count, 1)) / _DOF
        return self.centre + (z / jnp.sqrt(g)) @ self.root.T

    def log_density(self, x: jax.Array) -> jax.Array:
        """Return the log density (s,) of the points x (s, q)."""
        q = len(self.centre)
        z = solve_triangular(self.root, (x - self.centre).T, lower=True)
        constant = (
            gammaln(0.5 * (_DOF + q)) - gammaln(0.5 * _DOF) - 0.5 * q * jnp.log(_DOF * jnp.pi)
        )
        logs = jnp.sum(jnp.log(jnp.diagonal(self.root)))
        return constant - logs - 0.5 * (_DOF + q) * jnp.log1p(jnp.sum(z**2, axis=0) / _DOF)


def _informations(model: Model, errors: Errors, theta: np.ndarray, *, log: bool) -> np.ndarray:
    """Return F (k, q, q) at ``theta`` (q,), for each size that errors of unknown size may have."""
    means, valid = model.predict(dict(zip(model.states.unknowns, theta, strict=True)))
    _some(valid)
    error = errors(means)
    information = information_at(model, model.observe, model.noise, log=log)
    x = jnp.asarray(np.log(theta) if log else theta)
    matrices, _ = jax.jit(jax.vmap(lambda sizes: information(x, error, sizes)))(sizes_of(error))
    return np.asarray(matrices)


def _posterior_covariances(
    model: Model,
    errors: Errors,
    prior: np.ndarray,
    before: np.ndarray,
    count: int,
    seed: int,
    *,
    log: bool,
) -> np.ndarray:
    """Return the posterior covariances (r, q, q) given data made at draws of the prior (s, q)."""
    names = model.states.unknowns

    def thetas(x: jax.Array) -> jax.Array:
        return jnp.exp(x) if log else x

    def values(x: jax.Array) -> dict[str, jax.Array]:
        return dict(zip(names, thetas(x), strict=True))

    def log_prior(x: jax.Array) -> jax.Array:
        log_density = model.log_prior(values(x)) + (jnp.sum(x) if log else 0.0)
        return jnp.where(jnp.isnan(log_density), -jnp.inf, log_density)

    def predicted(x: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        return model.predict(values(x))

    def log_likelihood(
        x: jax.Array,
        answer: tuple[dict[str, jax.Array], jax.Array],
        data: dict[str, jax.Array],
        error: ModelError | None,
    ) -> jax.Array:
        means, valid = answer
        log_density = model.log_density({}, means, data)
        if error is not None:
            residual = {name: data[name] - mean for name, mean in means.items()}
            log_density += log_ratio(error, thetas(x), residual, means)
        return jnp.where(valid & jnp.isfinite(log_density), log_density, -jnp.inf)

    information = information_at(model, model.observe, model.noise, log=log)
    shared = jnp.asarray(np.log(prior[count:]) if log else prior[count:])[:_FROM_PRIOR]
    precision = jnp.asarray(np.linalg.inv(before))
    ask = jax.jit(partial(jax.lax.map, predicted, batch_size=_BATCH))
    ahead = ask(shared)
    p_shared = jax.vmap(log_prior)(shared)
    share = len(shared) / (len(shared) + _AROUND)

    def first(
        x: jax.Array, sizes: jax.Array, data: dict[str, jax.Array], error: ModelError | None
    ) -> _Around:
        """Return a Newton step from the data's own x, in the linear map with a normal prior."""
        Q = _inverse(information(x, error, sizes)[0] + precision)
        score = jax.grad(lambda x: log_likelihood(x, predicted(x), data, error))(x)
        score -= precision @ (x - shared.mean(axis=0))
        step = jnp.where(jnp.isfinite(score), score, 0.0)
        return _Around(x + Q @ step, _WIDER * jnp.linalg.cholesky(Q))

    def covariance(
        x: jax.Array,
        sizes: jax.Array,
        keys: jax.Array,
        means: dict[str, jax.Array],
        error: ModelError | None,
    ) -> jax.Array:
        noise_key, *round_keys, error_key = keys
        if error is not None:
            means = error.draw(error_key, jnp.concatenate([thetas(x), sizes]), means)
        parts = model.distributions({}, means)
        each = jax.random.split(noise_key, len(parts))
        data = {n: d.sample(k) for (n, d), k in zip(parts.items(), each, strict=True)}
        likely_shared = jax.vmap(log_likelihood, in_axes=(0, 0, None, None))(
            shared, ahead, data, error
        )
        around = start = first(x, sizes, data, error)
        C = normal = start.root @ start.root.T / _WIDER**2
        for k in round_keys:
            proposals = around.draw(k, _AROUND)
            inside = jax.vmap(log_prior)(proposals)
            # The map may be undefined at points of prior density 0, so it is evaluated at x there.
            evaluated = jnp.where(jnp.isfinite(inside)[:, None], proposals, x)
            likely = jax.lax.map(
                lambda x: log_likelihood(x, predicted(x), data, error), evaluated, batch_size=_BATCH
            )
            points = jnp.concatenate([shared, proposals])
            p = jnp.concatenate([p_shared, inside])
            mixture = jnp.logaddexp(
                jnp.log(share) + p, jnp.log1p(-share) + around.log_density(points)
            )
            weights = jax.nn.softmax(p + jnp.concatenate([likely_shared, likely]) - mixture)
            mean = weights @ points
            deviation = points - mean
            # A few draws that carry all weight hardly spread: their covariance would be too small.
            enough = 1.0 / jnp.sum(weights**2) >= _EFFECTIVE
            C = jnp.where(enough, (weights[:, None] * deviation).T @ deviation, normal)
            around = _Around(mean, _WIDER * jnp.linalg.cholesky(C))
        return C

    truths = jnp.asarray(np.log(prior[:count]) if log else prior[:count])
    means, valid = ask(truths)
    rows = _some(valid)
    truths, means = truths[rows], {name: mean[rows] for name, mean in means.items()}
    keys = jax.random.split(jax.random.key(seed), count)[rows]
    keys = jax.vmap(lambda key: jax.random.split(key, 2 + _ROUNDS))(keys)
    set_errors = of_each(errors, means)
    sets = truths, sizes_of(set_errors, count)[rows], keys, means, set_errors
    covariances = np.asarray(jax.jit(partial(jax.lax.map, lambda each: covariance(*each)))(sets))
    return covariances[_some(np.isfinite(covariances).all(axis=(1, 2)))]


def _some(valid: Any) -> np.ndarray:
    """Return the indices at which ``valid`` is true; :class:`InputError` if there are none."""
    if not np.any(valid):
        raise InputError("identifiability: the forward map has no valid answer at any draw")
    return np.flatnonzero(valid)


def _inverse(A: jax.Array) -> jax.Array:
    """Return the inverse of a symmetric positive definite matrix."""
    root = jnp.linalg.cholesky(A)
    half = solve_triangular(root, jnp.eye(len(A)), lower=True)
    return half.T @ half
