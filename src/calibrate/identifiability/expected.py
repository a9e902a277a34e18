r"""What data would determine, before there is any: posteriors of data that the prior expects.

For each of some draws of the prior data is made, :math:`y_r \sim p(y \mid x_r)`, and the covariance
of its posterior :math:`p(x \mid y_r)` is found by importance sampling, from draws of the prior and
of a Student's t about a Newton step from :math:`x_r`,

.. math:: w_i \propto \frac{p(x_i)\, p(y_r \mid x_i)}
                           {\alpha\, p(x_i) + (1 - \alpha)\, t_5(x_i;\, \hat x, S)},
          \qquad S = (F + P^{-1})^{-1},

with the Fisher information F of :mod:`calibrate.identifiability.fisher`, the prior's covariance P
and the share :math:`\alpha` of draws from the prior; :math:`\hat x` and S are then those of the
weighted draws, and it is done again (Cappe et al. 2008; Owen and Zhou 2000). Where too few draws
carry the weight the covariance is S. Posteriors are
averaged, not informations: by Jensen's inequality the inverse of a mean information is less than
the mean posterior covariance, and a box of a prior ends where a Gaussian does not.
:math:`x = \log\theta` where all unknowns are positive, else :math:`\theta`.
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

from calibrate.identifiability.combinations import combinations, prior_table
from calibrate.identifiability.fisher import informations, sensitivities
from calibrate.noise.information import information_about_means
from calibrate.statistical_model import Model
from emulator.errors import InputError

_DATA_SETS = 64
_FROM_PRIOR, _AROUND = 3072, 512  # draws of the prior, shared, and of Student's t, a data set
_ROUNDS = 2  # of Student's t
_BATCH = 128
_EFFECTIVE = 30.0  # draws; of fewer the covariance is that of the linear map and a normal prior
_DOF = 5.0
_WIDER = 1.3  # Student's t than the covariance it is told


def expected_precision(
    model: Model,
    at: Mapping[str, float] | None = None,
    *,
    data_sets: int = _DATA_SETS,
    seed: int = 0,
) -> dict[str, Any]:
    """What ``model``'s observations would determine, before any data; plain JSON.

    Parameters
    ----------
    at : unknowns by name where the map is taken as linear and the prior as normal; posteriors of
        ``data_sets`` draws of the prior and its data by default.

    Returns
    -------
    sd : per unknown, its expected posterior sd relative to the prior's, in log theta where all
        unknowns are positive.
    combinations : as of :func:`~calibrate.identifiability.identify`, of the mean posterior
        covariance, those of which something would be learned; empty where an unknown may be 0 or
        below.

    Raises
    ------
    InputError
        The forward map has no answer at any of the draws, or noise has no known sd.
    """
    if model.error is not None:
        raise InputError(
            "identify before measuring: the model allows for errors besides noise, which the data "
            "drawn here would not have; leave them out, or infer from synthetic data"
        )
    if any(model.noise_sites.values()):
        raise InputError(
            "identifiability: give every noise a known sd, as in GaussianNoise(sd=...)"
        )
    names, prior = model.states.unknowns, prior_table(model)
    log = bool((prior > 0.0).all())
    before = np.atleast_2d(np.cov(np.log(prior) if log else prior, rowvar=False))
    if at is None:
        covariances = _posterior_covariances(model, prior, before, data_sets, seed, log=log)
    else:
        where = np.array([[at[name] for name in names]])
        information = informations(model, where, log=log)
        covariances = np.linalg.inv(information + np.linalg.inv(before))
    sd = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)).mean(axis=0)
    ratio = sd / np.sqrt(np.diagonal(before))
    many = sum(int(np.prod(part.shape)) for part in model.observe.parts.values())
    found = combinations(names, covariances.mean(axis=0), before)[:many] if log else []
    return {"sd": dict(zip(names, ratio.tolist(), strict=True)), "combinations": found}


class _Around(NamedTuple):
    """Student's t: its centre (q,) and the Cholesky factor (q, q) of its scale matrix."""

    centre: jax.Array
    root: jax.Array

    def draw(self, key: jax.Array, count: int) -> jax.Array:
        """Draws (count, q)."""
        normal, chi2 = jax.random.split(key)
        q = len(self.centre)
        z = jax.random.normal(normal, (count, q))
        g = jax.random.chisquare(chi2, _DOF, (count, 1)) / _DOF
        return self.centre + (z / jnp.sqrt(g)) @ self.root.T

    def log_density(self, x: jax.Array) -> jax.Array:
        """Of x (s, q), shape (s,)."""
        q = len(self.centre)
        z = solve_triangular(self.root, (x - self.centre).T, lower=True)
        constant = (
            gammaln(0.5 * (_DOF + q)) - gammaln(0.5 * _DOF) - 0.5 * q * jnp.log(_DOF * jnp.pi)
        )
        logs = jnp.sum(jnp.log(jnp.diagonal(self.root)))
        return constant - logs - 0.5 * (_DOF + q) * jnp.log1p(jnp.sum(z**2, axis=0) / _DOF)


def _posterior_covariances(
    model: Model, prior: np.ndarray, before: np.ndarray, count: int, seed: int, *, log: bool
) -> np.ndarray:
    """Covariances (r, q, q) of the posteriors of data made at draws of the prior (s, q)."""
    names = model.states.unknowns

    def values(x: jax.Array) -> dict[str, jax.Array]:
        return dict(zip(names, jnp.exp(x) if log else x, strict=True))

    def log_prior(x: jax.Array) -> jax.Array:
        found = model.log_prior(values(x)) + (jnp.sum(x) if log else 0.0)
        return jnp.where(jnp.isnan(found), -jnp.inf, found)

    def predicted(x: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        return model.predict(values(x))

    def log_likelihood(
        means: dict[str, jax.Array], valid: jax.Array, data: dict[str, jax.Array]
    ) -> jax.Array:
        found = model.log_density(means, model.noise_values({}), data)
        return jnp.where(valid & jnp.isfinite(found), found, -jnp.inf)

    sensitivity = sensitivities(model, model.observe, log=log)
    shared = jnp.asarray(np.log(prior[count:]) if log else prior[count:])[:_FROM_PRIOR]
    precision = jnp.asarray(np.linalg.inv(before))
    ahead, answers = jax.jit(partial(jax.lax.map, predicted, batch_size=_BATCH))(shared)
    p_shared = jax.vmap(log_prior)(shared)
    share = len(shared) / (len(shared) + _AROUND)

    def first(x: jax.Array, data: dict[str, jax.Array]) -> _Around:
        """A Newton step from where the data was made, in the linear map with a normal prior."""
        means, J, _ = sensitivity(x)
        S = _inverse(J.T @ information_about_means(model.noise, means) @ J + precision)
        score = jax.grad(lambda x: log_likelihood(*predicted(x), data))(x)
        score -= precision @ (x - shared.mean(axis=0))
        step = jnp.where(jnp.isfinite(score), score, 0.0)
        return _Around(x + S @ step, _WIDER * jnp.linalg.cholesky(S))

    def covariance(x: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        means, valid = model.predict(values(x))
        noise, *keys = jax.random.split(key, 1 + _ROUNDS)
        parts = model.distributions(means, model.noise_values({}))
        each = jax.random.split(noise, len(parts))
        data = {n: d.sample(k) for (n, d), k in zip(parts.items(), each, strict=True)}
        told = jax.vmap(log_likelihood, in_axes=(0, 0, None))(ahead, answers, data)
        around = start = first(x, data)
        C = normal = start.root @ start.root.T / _WIDER**2
        for k in keys:
            drawn = around.draw(k, _AROUND)
            inside = jax.vmap(log_prior)(drawn)
            # Where the prior is nothing the map is not asked.
            asked = jnp.where(jnp.isfinite(inside)[:, None], drawn, x)
            likely = jax.lax.map(
                lambda x: log_likelihood(*predicted(x), data), asked, batch_size=_BATCH
            )
            points = jnp.concatenate([shared, drawn])
            p = jnp.concatenate([p_shared, inside])
            mixture = jnp.logaddexp(
                jnp.log(share) + p, jnp.log1p(-share) + around.log_density(points)
            )
            weights = jax.nn.softmax(p + jnp.concatenate([told, likely]) - mixture)
            mean = weights @ points
            off = points - mean
            # A few draws that carry all weight have next to no spread, and would promise too much.
            enough = 1.0 / jnp.sum(weights**2) >= _EFFECTIVE
            C = jnp.where(enough, (weights[:, None] * off).T @ off, normal)
            around = _Around(mean, _WIDER * jnp.linalg.cholesky(C))
        return C, valid & jnp.isfinite(C).all()

    truths = jnp.asarray(np.log(prior[:count]) if log else prior[:count])
    keys = jax.random.split(jax.random.key(seed), count)
    found, valid = jax.jit(partial(jax.lax.map, lambda pair: covariance(*pair)))((truths, keys))
    if not valid.any():
        raise InputError("identifiability: the forward map has no valid answer at any draw")
    return np.asarray(found)[np.asarray(valid)]


def _inverse(A: jax.Array) -> jax.Array:
    """Of a symmetric positive definite matrix."""
    root = jnp.linalg.cholesky(A)
    half = solve_triangular(root, jnp.eye(len(A)), lower=True)
    return half.T @ half
