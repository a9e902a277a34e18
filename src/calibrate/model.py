r"""The statistical model around a forward map.

.. math:: y = \mathcal{O}\,u(\theta) + \varepsilon, \qquad \varepsilon \sim N(0, \sigma^2 I)

with theta from its prior and sigma known or with a half-normal prior. The model does not know
whether the forward map is the emulator, the emulator with a correction, a reduced model or FEM.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

from calibrate.noise import GaussianNoise
from calibrate.observations import Observation
from calibrate.priors import Prior, box_prior, check_prior
from emulator.errors import InputError
from emulator.forward import ForwardMap

NOISE_SD = "noise_sd"


@dataclass(frozen=True, eq=False)
class Model:
    """A NumPyro model: call it with the data.

    Parameters
    ----------
    forward : map restricted to the observed nodes.
    full : the same map over all nodes.
    observe : what of the displacement was measured.
    noise : of the measurement.
    prior : one distribution a parameter.
    """

    forward: ForwardMap
    full: ForwardMap
    observe: Observation
    noise: GaussianNoise
    prior: Prior

    @property
    def names(self) -> tuple[str, ...]:
        """What is inferred: theta's entries, then the noise when unknown."""
        theta = self.forward.scene.parameter_names
        return theta if self.noise.sd is not None else (*theta, NOISE_SD)

    def __call__(self, data: jax.Array | None = None) -> None:
        """The NumPyro program; ``data`` (d, 3) mm."""
        scene = self.forward.scene
        theta = jnp.stack(
            [numpyro.sample(name, self.prior[name]) for name in scene.parameter_names]
        )
        prediction = self.forward.evaluate(theta)
        # Where the forward map has no answer, the density is zero, not NaN.
        numpyro.factor("valid", jnp.where(prediction.valid, 0.0, -jnp.inf))
        sd = self.noise.sd
        if sd is None:
            sd = numpyro.sample(NOISE_SD, dist.HalfNormal(self.noise.sd_scale))
        mean = self.observe(jnp.where(prediction.valid, prediction.displacement, 0.0))
        numpyro.sample("observed", dist.Normal(mean, sd).to_event(2), obs=data)

    def log_likelihood(self, displacement: jax.Array, sd: jax.Array, data: jax.Array) -> jax.Array:
        """Log density of ``data`` given the displacement (k, 3) of the observed nodes, shape ()."""
        return jnp.sum(dist.Normal(self.observe(displacement), sd).log_prob(data))

    def check_data(self, data: np.ndarray) -> jax.Array:
        """``data`` as (d, 3) float64; :class:`InputError` on a wrong shape or value."""
        values = np.asarray(data, dtype=float)
        expected = (len(self.observe.points), 3)
        if values.shape != expected:
            raise InputError(f"data has shape {values.shape}; the observation expects {expected}")
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
            raise InputError(f"data: row {row} has a value that is not finite; remove that point")
        return jnp.asarray(values)


def model(
    forward: ForwardMap,
    observe: Observation,
    noise: GaussianNoise,
    prior: Prior | None = None,
) -> Model:
    """The model of data observed through ``observe``; the prior is the scene's box by default."""
    scene = forward.scene
    prior = box_prior(scene) if prior is None else check_prior(scene, prior)
    return Model(forward.at(observe.nodes), forward, observe, noise, prior)
