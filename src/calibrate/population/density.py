r"""The posterior of a population, its members integrated out.

Members are sampled alone first, each under the prior :math:`\pi_i` of its model. From its draws,
the likelihood of a member is a mixture of normals on the parameters' scales
(:mod:`calibrate.population.mixtures`), around a point :math:`b_i`,

.. math:: \ell_i(x) = \sum_j e^{c_{ij} + h_{ij}^T t - t^T \Lambda_{ij} t / 2}, \qquad t = x - b_i .

Under a population of means m and covariance :math:`M M^T`, :math:`M = \text{diag}(s) L`, its
integral has a closed form. With the slope :math:`g = h - \Lambda (m - b)` at the mean,

.. math::
    \int \ell(x)\, N(x; m, M M^T)\, dx = \sum_j e^{v_j} |A_j|^{-1/2}
    e^{g^T M A^{-1} M^T g / 2}, \qquad A = I + M^T \Lambda M,

where v is the exponent at m. So the population has a density of its own, smooth for any sd, with no
member to move, on which NUTS is fast. Each member also divides by the mass of the population within
the ranges, :math:`\prod_k [\Phi(b_k) - \Phi(a_k)]`, as if parameters were independent there.

Both are approximations, and the draws know better: with :math:`x_{ij}` as draws of member i,

.. math:: p(y_i \mid m, s, R) \propto \frac 1S \sum_j w_{ij}, \qquad
          w_{ij} = \frac{p(x_{ij} \mid m, s, R)}{\pi_i(x_{ij})}

with the exact density of :mod:`calibrate.population.model` (Lunn, Barrett, Sweeting and Thompson
2013 sample members so). The ratio of both weighs the population's draws. A member of a draw of the
population is one of its draws, in proportion to :math:`w_{ij}`. The sums are over few draws where
the population is narrow: with shares :math:`v_{ij}` of the sum, the variance of the log likelihood
is about :math:`\sum_i (\sum_j v_{ij}^2 - 1/S)`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.special import ndtr
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import potential_energy

from calibrate.population.mixtures import Mixtures
from calibrate.population.model import CHOLESKY, MEDIAN, SD, PopulationDraws, PopulationModel
from calibrate.statistical_model.density import Target
from emulator.core.kept import kept
from emulator.core.machine import cores
from emulator.core.small_matrices import eliminate


class Alone(NamedTuple):
    """Draws of the members alone.

    x : the shared unknowns (n, S, k) on their parameters' scales.
    log_prior : the log density (n, S) of each under its model's prior.
    """

    x: Any
    log_prior: Any


class Weighed(NamedTuple):
    """The draws of the members at draws of the population.

    log_weight : (s,) of the population's draws, by the exact density over the mixtures'.
    variance : (s,) of the log likelihood of each, from the number of draws that count there.
    member_draws : (s, n) the draw that each member has.
    in_use : (n,) the number of each member's draws that they rest on.
    """

    log_weight: np.ndarray
    variance: np.ndarray
    member_draws: np.ndarray
    in_use: np.ndarray


@dataclass(frozen=True)
class PopulationDensity(Target):
    """The posterior of a population from :class:`~calibrate.population.mixtures.Mixtures`.

    constrain : z (s, p) -> population (s, ...).
    values : (population (s, ...), scores (s, ..., k)) -> shared unknowns by name (s, ...).
    weigh : (rng_key, z (s, p), mixtures, :class:`Alone`) -> :class:`Weighed`.
    """

    constrain: Callable[[jax.Array], PopulationDraws]
    values: Callable[..., dict[str, jax.Array]]
    weigh: Callable[[jax.Array, np.ndarray, Mixtures, Alone], Weighed]


@kept
def density_of_population(model: PopulationModel) -> PopulationDensity:
    """Return the density of the posterior of a population, up to a constant."""
    transforms = {name: biject_to(prior.support) for name, prior in model.sampled_priors.items()}
    draw = handlers.trace(handlers.seed(model, jax.random.key(0))).get_trace()
    example = {name: transforms[name].inv(site["value"]) for name, site in draw.items()}
    flat, unravel = ravel_pytree(example)

    def population_at(z: jax.Array) -> PopulationDraws:
        values = {name: transforms[name](value) for name, value in unravel(z).items()}
        medians, sds = (
            jnp.stack([values[f"{role}[{k}]"] for k in model.shared]) for role in (MEDIAN, SD)
        )
        return PopulationDraws(medians, sds, values.get(CHOLESKY, jnp.eye(len(model.shared))))

    def log_density(z: jax.Array, mixtures: Mixtures) -> jax.Array:
        log_prior = -potential_energy(model, (), {}, unravel(z))
        return log_prior + jnp.sum(log_likelihoods(model, population_at(z), mixtures))

    @jax.jit
    def at_draws(
        keys: jax.Array, z: jax.Array, mixtures: Mixtures, alone: Alone
    ) -> tuple[jax.Array, ...]:
        def at(key_and_z: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, ...]:
            key, z = key_and_z
            population = population_at(z)
            log_weights = model.log_density(alone.x, population) - alone.log_prior
            exact = jax.nn.logsumexp(log_weights, axis=1)
            ratio = exact - log_likelihoods(model, population, mixtures)
            shares = jnp.exp(log_weights - exact[:, None])
            variance = jnp.sum(jnp.sum(shares**2, axis=1) - 1.0 / shares.shape[1])
            sums = jnp.cumsum(shares, axis=1)
            at = jax.random.uniform(key, (len(sums),)) * sums[:, -1]
            return jnp.sum(ratio), variance, jnp.sum(sums < at[:, None], axis=1)

        return jax.lax.map(at, (keys, z))

    def weigh(key: jax.Array, z: np.ndarray, mixtures: Mixtures, alone: Alone) -> Weighed:
        log_weight, variance, chosen = map(
            np.asarray, at_draws(jax.random.split(key, len(z)), jnp.asarray(z), mixtures, alone)
        )
        in_use = np.array([_in_use(column) for column in chosen.T])
        return Weighed(log_weight, variance, chosen, in_use)

    return PopulationDensity(
        log_density,
        dimension=int(np.size(flat)),
        piloted=False,
        at_once=cores(),
        constrain=jax.jit(jax.vmap(population_at)),
        values=jax.jit(jax.vmap(model.shared_values)),
        weigh=weigh,
    )


def log_likelihoods(
    model: PopulationModel, population: PopulationDraws, mixtures: Mixtures
) -> jax.Array:
    """Return the log likelihood (n,) of one population, from each member's mixture."""
    mean, ends = model.means(population.median), model.ends
    M = population.sd[:, None] * population.factor

    def of_part(
        centre: jax.Array, constant: jax.Array, slope: jax.Array, precision: jax.Array
    ) -> jax.Array:
        t = mean - centre
        g = slope - precision @ t
        value = constant + 0.5 * (slope + g) @ t
        pivots, rows = eliminate(jnp.eye(len(t)) + M.T @ precision @ M, (M.T @ g)[:, None])
        return value + 0.5 * jnp.sum(rows[:, 0] ** 2 / pivots - jnp.log(pivots))

    of_member = jax.vmap(of_part, in_axes=(None, 0, 0, 0))
    by_part = jax.vmap(of_member)(*mixtures)
    low, high = ((end - mean) / population.sd for end in ends)
    return jax.nn.logsumexp(by_part, axis=1) - jnp.sum(jnp.log(ndtr(high) - ndtr(low)))


def _in_use(chosen: np.ndarray) -> float:
    r"""Return the effective number of different draws among ``chosen`` (s,).

    Two at random are the same with the probability :math:`\sum_j \bar w_j^2`, one over it.
    """
    counts = np.bincount(chosen)
    same = float(np.sum(counts * (counts - 1.0)))
    pairs = len(chosen) * (len(chosen) - 1.0)
    return pairs / same if same > 0.0 else pairs
