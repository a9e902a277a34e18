r"""Whether the data could have come from the model: posterior predictive checks.

For draws of FEM's posterior and data :math:`\tilde y` simulated from each, two discrepancies
between data and prediction (Gelman, Meng and Stern 1996),

.. math:: T_1(y, \theta) = -\log p(y \mid \theta), \qquad
    T_2(y, \theta) = \max_j |y_j - \mathrm{E} y_j| / \mathrm{sd}\, y_j

have p-values :math:`P(T(\tilde y, \theta) \ge T(y, \theta))`. With Gaussian noise :math:`T_1` is
half of chi squared. Near 0: the data lies further from every prediction than the noise allows
(outliers, a registration error, a wrong law, a noise sd too small). :math:`T_1` near 1: closer than
noise would let it (an sd too large).

What this cannot see: an error that parameters can absorb, a wrong sd of a single number, and a
wrong sd where the sd is inferred.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.certificate.correction import Correction
from calibrate.certificate.predictive import Predictive
from calibrate.posterior.fit import Misfit, places_of

DRAWS = 1000


def misfits(
    predictive: Predictive,
    correction: Correction,
    z: np.ndarray,
    rng_key: jax.Array,
) -> dict[str, Misfit]:
    """Misfit of each observation by its name, from draws (s, p) of FEM's posterior."""
    draws = {name: jnp.asarray(values) for name, values in predictive.constrain(z).items()}
    flat = jnp.asarray(predictive.corrected_means(z, correction))
    shapes = predictive.model.observe.shapes

    def one(flat: jax.Array, draw: dict[str, jax.Array], key: jax.Array) -> Any:
        values = predictive.model.noise_values(draw)
        means = predictive.by_name(flat)
        parts = predictive.model.distributions(means, values)
        key, own = jax.random.split(key)
        moved = predictive.model.fem_means(own, draw, means)
        keys = jax.random.split(key, len(parts))
        return {
            name: _compared(d, means[name], moved[name] - means[name], predictive.data[name], k)
            for (name, d), k in zip(parts.items(), keys, strict=True)
        }

    found = jax.jit(jax.vmap(one))(flat, draws, jax.random.split(rng_key, len(z)))
    misfit = {}
    for name, (whole, *distances) in found.items():
        simulated, distance = (np.asarray(x).reshape(len(z), -1) for x in distances)
        misfit[name] = Misfit.of(places_of(name, shapes[name]), whole, simulated, distance)
    return misfit


def _compared(
    d: Any, mean: jax.Array, error: jax.Array, y: jax.Array, rng_key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """At one draw: whether simulated data is as unlikely as y, and both their distances."""
    simulated = d.sample(rng_key) + error
    return d.log_prob(simulated) <= d.log_prob(y), jnp.abs(simulated - mean), jnp.abs(y - mean)
