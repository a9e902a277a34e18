r"""The log density of a population and its members on real coordinates.

NumPyro maps the population and own unknowns to the real line, as of any model; the members' scores
are replaced by coordinates in which the members are about independent of the population, with their
Jacobian.

Given the population, :math:`x_i = x(q_i)` with scores :math:`q_i = L z_i`. A member without
informative data wants :math:`z_i` as its coordinates, one whose data fixes :math:`x_i` wants
:math:`x_i`: in the others the posterior is a funnel, or a thin sheet. Take the member's log
likelihood for quadratic around a value :math:`\bar x_i`, with slope :math:`g_i` and precision
:math:`\Lambda_i`, and :math:`x(q)` for linear around the score :math:`\bar q_i` of
:math:`\bar x_i`, with slopes :math:`D = \text{diag}(dx_k/dq_k)`. Then :math:`z_i` given the
population is Gaussian, and in

.. math:: z_i = P^{-1} L^T D\,(g_i + \Lambda_i D \bar q_i) + C^{-T} e_i, \qquad
          P = I + L^T D \Lambda_i D L = C C^T

:math:`e_i` is standard normal and independent of the population. The change of variables has the
determinant :math:`\prod_k C_{kk}^{-1}` and is exact for *any* :math:`\bar x_i`, :math:`g_i` and
:math:`\Lambda_i`; good ones make the posterior round. They come from the member's own posterior, by
dividing by its prior (both as Gaussians),

.. math:: \Lambda_i = A^{-1} - B^{-1}, \qquad g_i = B^{-1} (\bar x_i - \bar b_i)

with mean and covariance :math:`\bar x_i, A` of its draws and :math:`\bar b_i, B` of its prior's, in
the directions in which that is positive; elsewhere 0. A member without data has
:math:`e_i = z_i`. (Partial non-centring: Papaspiliopoulos, Roberts and Sköld 2007.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import potential_energy

from calibrate.population.model import (
    CHOLESKY,
    MEDIAN,
    SCORES,
    SD,
    PopulationModel,
    ends,
    to_scale,
    to_score,
)
from calibrate.statistical_model import Data
from calibrate.statistical_model.density import Target, threads_for
from emulator.core.kept import kept
from emulator.core.small_matrices import eliminate


class Information(NamedTuple):
    """The information of each member's data on its shared unknowns, on their scales.

    value : the point (n, k) at which the log likelihood is expanded.
    slope, precision : its slope (n, k) there, and minus its Hessian (n, k, k).
    """

    value: jax.Array
    slope: jax.Array
    precision: jax.Array


def information_of(draws: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return value (k,), slope (k,) and precision (k, k) from draws (s, k), and the prior's."""
    root = np.linalg.cholesky(np.atleast_2d(np.cov(prior.T)))
    whitened = np.linalg.solve(root, (draws - prior.mean(axis=0)).T)
    sizes, axes = np.linalg.eigh(np.atleast_2d(np.cov(whitened)))
    # Directions in which draws happen to spread more than the prior are left out.
    precision = np.maximum(1.0 / np.maximum(sizes, 1e-12) - 1.0, 0.0)
    shift = np.where(precision > 0.0, axes.T @ whitened.mean(axis=1), 0.0)
    back = np.linalg.solve(root.T, axes)
    return draws.mean(axis=0), back @ shift, (back * precision) @ back.T


def scores_of(
    e: jax.Array, information: Information, cut: Sequence[jax.Array], factor: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return scores z (n, k) at coordinates ``e`` (n, k), and the log determinant of dz/de, ().

    cut : mean and sd of the population before the cut, and both ends of the range, (k,) each, on
        the parameters' scales.
    factor : the lower factor L (k, k) of the correlation of the scores.
    """

    def of_member(e: jax.Array, information: Information) -> tuple[jax.Array, jax.Array]:
        score, slope = to_score(information.value, *cut)
        root = slope[:, None] * factor
        P = jnp.eye(len(e)) + root.T @ information.precision @ root
        gradient = information.slope + information.precision @ (slope * score)
        # P = L diag(pivots) L^T, so that C = L diag(sqrt(pivots)).
        pivots, inverse_L = eliminate(P, jnp.eye(len(e)))
        inverse_C = inverse_L / jnp.sqrt(pivots)[:, None]
        z = inverse_C.T @ (inverse_C @ (root.T @ gradient) + e)
        return z, -0.5 * jnp.sum(jnp.log(pivots))

    z, log_determinants = jax.vmap(of_member)(e, information)
    return z, jnp.sum(log_determinants)


class Conditions(NamedTuple):
    """The inputs of the posterior of a population.

    data : data by member and observation; members without data are missing.
    information : the information from which the coordinates are made; it does not change the
        posterior.
    """

    data: Mapping[str, Data]
    information: Information


class PopulationDraws(NamedTuple):
    """Median and sd (k,) of a population, and the lower factor L (k, k) of its correlation."""

    median: jax.Array
    sd: jax.Array
    factor: jax.Array


@dataclass(frozen=True)
class PopulationDensity(Target):
    """The posterior of a population.

    constrain : (z (s, p), information) -> population, scores (s, n, k), own unknowns by site (s,).
    values : (*population (s, ...), scores (s, ..., k)) -> shared unknowns by name (s, ...).
    """

    constrain: Callable[[jax.Array, Information], tuple[PopulationDraws, jax.Array, dict[str, Any]]]
    values: Callable[..., dict[str, jax.Array]]


@kept
def density_of_population(model: PopulationModel) -> PopulationDensity:
    """Return the density of the posterior of population and members, up to a constant."""
    sites = handlers.trace(handlers.seed(model, jax.random.key(0))).get_trace()
    sampled = {name: site for name, site in sites.items() if site["type"] == "sample"}
    transforms = {name: biject_to(site["fn"].support) for name, site in sampled.items()}
    example = {name: transforms[name].inv(site["value"]) for name, site in sampled.items()}
    flat, unravel = ravel_pytree(example)

    def population_at(values: Mapping[str, jax.Array]) -> PopulationDraws:
        medians, sds = (
            jnp.stack([transforms[f"{role}[{k}]"](values[f"{role}[{k}]"]) for k in model.shared])
            for role in (MEDIAN, SD)
        )
        single = CHOLESKY not in values
        factor = jnp.eye(1) if single else transforms[CHOLESKY](values[CHOLESKY])
        return PopulationDraws(medians, sds, factor)

    def with_scores(z: jax.Array, information: Information) -> Any:
        values = unravel(z)
        population = population_at(values)
        mean = [to_scale(p, population.median[k]) for k, p in enumerate(model.shared.values())]
        low, high = jnp.array([ends(parameter) for parameter in model.shared.values()]).T
        cut = jnp.stack(mean), population.sd, low, high
        scores, log_determinant = scores_of(values[SCORES], information, cut, population.factor)
        return {**values, SCORES: scores}, population, log_determinant

    def log_density(z: jax.Array, conditions: Conditions) -> jax.Array:
        values, _, log_determinant = with_scores(z, conditions.information)
        return log_determinant - potential_energy(model, (conditions.data,), {}, values)

    def constrain(z: jax.Array, information: Information) -> Any:
        values, population, _ = with_scores(z, information)
        member_values = {
            f"{name}[{member}]": transforms[f"{name}[{member}]"](values[f"{name}[{member}]"])
            for member, names in model.unshared.items()
            for name in names
        }
        return population, values[SCORES], member_values

    return PopulationDensity(
        log_density,
        dimension=int(np.size(flat)),
        piloted=False,  # a transport map has too many monomials; members are straight already
        at_once=min(threads_for(member.forward) for member in model.members.values()),
        constrain=jax.jit(jax.vmap(constrain, in_axes=(0, None))),
        values=jax.jit(jax.vmap(model.shared_values)),
    )
