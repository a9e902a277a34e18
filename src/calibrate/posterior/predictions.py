r"""Predictions of a model at draws: replicated data, and the log likelihood of each datum.

Replicates :math:`y^\text{rep} \sim p(y \mid \theta_s)` are drawn at draws of the posterior and of
the prior. The log likelihood :math:`\log p(y_i \mid \theta_s)` of every datum at every draw is what
leave-one-out cross-validation needs (Vehtari, Gelman and Gabry 2017); where noise correlates in
space, :math:`\log p(y_i \mid y_{-i}, \theta_s)` takes its place. All are read off the NumPyro
program, so they follow any observation and noise.

**Pressure-volume curves.** At a draw of the prior the cavity has the volumes :math:`V_k` at the
pressures :math:`P_k` over the range of its pressure. With Klotz's relation :math:`P(V)` through a
measured point, or through the draw's own last one, the draw lies in the band of half-width h where

.. math:: \max_k |P(V_k) - P_k| \le h .

The band of a measured point says whether the prior can explain it; that of the draw's own point
judges the shape alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from calibrate.measurements import Observation, Observations
from calibrate.measurements.klotz import PRESSURE_SCATTER, Klotz
from calibrate.measurements.outputs import Outputs
from calibrate.measurements.volume import pressure_volume
from calibrate.noise.correlated import SpatialNormal
from calibrate.statistical_model import Data, Model
from calibrate.statistical_model.density import density_of, prior_draws
from calibrate.statistical_model.many_draws import in_blocks, means_at
from emulator.core.errors import InputError, check_known, check_seed
from emulator.core.kept import kept
from emulator.surrogates.protocol import ForwardMap

REPLICATES = 500  # draws of the posterior, and of the prior, at which data is replicated

Draws = Mapping[str, Any]
"""Draws by the model's names, each (chains, draws)."""


class Prior(NamedTuple):
    """Draws of the prior where the forward map has an answer, and data replicated there.

    draws : the draws by the model's names, each (s,).
    data : the replicated data by the observation's name, each (s, *shape).
    """

    draws: dict[str, np.ndarray]
    data: dict[str, np.ndarray]


def means_of(model: Model, draws: Draws) -> dict[str, np.ndarray]:
    """Return data without noise at each draw, (chains, draws, *shape), by the forward map."""
    return _unflat(means_at(model, _flat(draws))[0], draws)


def log_likelihood(
    model: Model, draws: Draws, data: Mapping[str, Any], means: Draws | None = None
) -> dict[str, np.ndarray]:
    """Return the log likelihood of each datum at each draw, (chains, draws, *shape), by name.

    Where noise correlates in space, given all other data of the observation. Data of a noise that
    has no density of a single one have one number a draw instead, (chains, draws).

    means : data without noise (chains, draws, *shape), where the draws are not of the model's own
        posterior; by its forward map otherwise.
    """
    at = _flat(means_of(model, draws) if means is None else means)
    return _unflat(_over_draws(model, _log_likelihood)((_flat(draws), at), dict(data)), draws)


@kept
def outputs_of(observe: Observation, forward: ForwardMap) -> Outputs:
    """Return the outputs; kept, so that a loop over pressures compiles once."""
    return Outputs(forward, Observations({"observed": observe}))


def replicates(
    model: Model, draws: Draws, rng_key: jax.Array, means: Draws | None = None
) -> dict[str, np.ndarray]:
    """Return data replicated at each draw, (chains, draws, *shape), by the observation's name.

    ``means`` as of :func:`log_likelihood`.
    """
    at = _flat(means_of(model, draws) if means is None else means)
    return _unflat(_replicated(model, _flat(draws), at, rng_key), draws)


def prior_replicates(model: Model, rng_key: jax.Array, count: int = REPLICATES) -> Prior:
    """Return up to ``count`` draws of the prior, and data replicated there.

    A tenth more is drawn; draws at which the map has no answer are left out (:func:`shortfall`).
    """
    density = density_of(model)
    draw_key, data_key = jax.random.split(rng_key)
    z = prior_draws(density, draw_key, count + count // 10)
    draws = in_blocks(density.constrain, z)
    means, valid = means_at(model, draws)
    data = jax.tree.map(np.asarray, _replicated(model, draws, means, data_key))
    rows = np.flatnonzero(valid)[:count]
    return Prior(*({n: values[rows] for n, values in by.items()} for by in (draws, data)))


def shortfall(count: int, asked: int = REPLICATES) -> list[str]:
    """Return a sentence where the prior gives ``count`` data sets and more were asked for."""
    if count >= asked:
        return []
    return [
        f"the prior predicts {count} data sets in place of {asked}: the forward map has no answer "
        "at too many of its draws; give a narrower prior"
    ]


def spread(draws: Draws, count: int = REPLICATES) -> tuple[np.ndarray, Draws]:
    """Return indices and values of about ``count`` draws, evenly spaced along the chains."""
    chains, length = next(iter(draws.values())).shape
    count_per_chain = min(length, -(-count // chains))
    rows = np.linspace(0, length - 1, count_per_chain).astype(int)
    return rows, {name: np.asarray(values)[:, rows] for name, values in draws.items()}


def _replicated(model: Model, draws: Draws, means: Draws, rng_key: jax.Array) -> dict[str, Any]:
    """Return data replicated at draws (s,), around their ``means`` (s, *shape)."""
    keys = jax.random.split(rng_key, len(next(iter(draws.values()))))
    return _over_draws(model, _replicate)((draws, means, keys))


def _log_likelihood(model: Model, draw: Data, means: Data, data: Data) -> dict[str, jax.Array]:
    around = model.distributions(draw, means)
    return {name: _pointwise(d, data[name]) for name, d in around.items()}


def _replicate(model: Model, draw: Data, means: Data, rng_key: jax.Array) -> dict[str, jax.Array]:
    error_key, *keys = jax.random.split(rng_key, len(means) + 1)
    around = model.distributions(draw, model.means_with_errors(error_key, draw, means))
    return {name: d.sample(k) for (name, d), k in zip(around.items(), keys, strict=True)}


@kept
def _over_draws(model: Model, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the program of ``function(model, *one, *rest)`` over many draws, one by one."""
    return jax.jit(
        lambda draws, *rest: jax.lax.map(lambda one: function(model, *one, *rest), draws)
    )


def _pointwise(distribution: Any, value: jax.Array) -> jax.Array:
    """Return each datum's log density, conditional on the other data where they correlate."""
    if isinstance(distribution, SpatialNormal):
        return distribution.log_conditionals(value)
    while isinstance(distribution, dist.Independent):
        distribution = distribution.base_dist
    log_densities = distribution.log_prob(value)
    return log_densities if log_densities.shape == jnp.shape(value) else jnp.sum(log_densities)


def _flat(values: Draws) -> dict[str, jax.Array]:
    """Return the values with the chains one after the other, (s, *shape)."""
    return {n: jnp.asarray(v).reshape(-1, *np.shape(v)[2:]) for n, v in values.items()}


def _unflat(values: Any, draws: Draws) -> dict[str, np.ndarray]:
    shape = next(iter(draws.values())).shape
    return {name: np.asarray(v).reshape(*shape, *v.shape[1:]) for name, v in values.items()}


DRAWS = 200


class KlotzBand(NamedTuple):
    """Curves of a prior against Klotz's relation.

    apart : the largest difference of pressure at each draw, (s,) kPa.
    band : the half-width of the band, kPa.
    left_out : the number of draws at which the forward map has no answer.
    """

    apart: np.ndarray
    band: float
    left_out: int

    @property
    def fraction(self) -> float:
        """Share of the draws that lie in the band."""
        return float(np.mean(self.apart <= self.band))


def klotz_band(
    model: Model,
    point: Klotz | None = None,
    band: float = PRESSURE_SCATTER,
    count: int = DRAWS,
    seed: int = 0,
    state: str | None = None,
) -> KlotzBand:
    """Return the band in which ``count`` curves of the prior lie.

    Parameters
    ----------
    point : the relation through a measured volume; by default each draw's own, at its largest
        pressure.
    band : the half-width of the band in kPa; by default 3 mmHg, which is above the published root
        mean square errors of the relation.
    state : the load state whose parameters, but for the pressure, a curve has; by default the last.
        Muscle must be at rest there.

    Raises
    ------
    InputError
        A scene without a cavity whose pressure is a parameter, a band or count that is not above 0,
        pressures beyond the relation's, an unknown state, or no valid curve.
    """
    if not band > 0.0 or count < 1:
        raise InputError(f"klotz: band {band} kPa and {count} draws; both must be above 0")
    check_seed(seed, "klotz")
    curve = pressure_volume(model.full)
    if curve is None:
        raise InputError(
            f"klotz: scene '{model.forward.scene.name}' has no cavity whose pressure is a parameter"
        )
    if point is None:
        Klotz(1.0, curve.pressures[-1])  # refuses what the relation does not reach
    pressures = jnp.asarray(curve.pressures)

    def apart(theta: jax.Array) -> jax.Array:
        volumes = curve.volumes(theta)
        through = Klotz(volumes[-1], pressures[-1]) if point is None else point
        return jnp.max(jnp.abs(through.pressure(volumes) - pressures))

    if state is not None:
        check_known(state, model.states.states, "klotz: load state")
    row = -1 if state is None else model.states.states.index(state)
    thetas = model.states.thetas(model.prior_draws(jax.random.key(seed), count))[:, row]
    curves = np.asarray(jax.jit(partial(jax.lax.map, apart))(thetas))
    valid = curves[np.isfinite(curves)]
    if not valid.size:
        raise InputError(f"klotz: the forward map has no answer at any of {count} draws")
    return KlotzBand(valid, band, count - valid.size)
