r"""The statistical model around a forward map.

.. math:: y_j = \mathcal{O}_j\,u(\theta) + \varepsilon_j, \qquad
          \varepsilon_j \sim N(0, \sigma_j^2 I)

for each thing observed, with theta from its prior and every sigma known or with a half-normal prior
of its own. The model does not know whether the forward map is the emulator, the emulator with a
correction, a reduced model or FEM.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

from calibrate.noise import GaussianNoise
from calibrate.observations import Observation, Observations, observations
from calibrate.priors import Prior, box_prior, check_prior
from emulator.errors import InputError
from emulator.surrogates.protocol import ForwardMap

NOISE_SD = "noise_sd"

Data = Mapping[str, jax.Array]
"""Data by the observation's name; each of the observation's shape and unit."""


@dataclass(frozen=True, eq=False)
class Model:
    """A NumPyro model: call it with the data.

    Parameters
    ----------
    forward : map restricted to the observed nodes.
    full : the same map over all nodes.
    observe : what of the displacement was measured, by name.
    noise : of each measurement.
    prior : one distribution a parameter.
    """

    forward: ForwardMap
    full: ForwardMap
    observe: Observations
    noise: Mapping[str, GaussianNoise]
    prior: Prior

    @property
    def inferred_noise(self) -> dict[str, str]:
        """Observation to the name of its noise's standard deviation, where that is inferred.

        ``noise_sd`` when one thing is observed, ``noise_sd_<observation>`` when several are.
        """
        alone = len(self.noise) == 1
        return {
            name: NOISE_SD if alone else f"{NOISE_SD}_{name}"
            for name, noise in self.noise.items()
            if noise.sd is None
        }

    @property
    def names(self) -> tuple[str, ...]:
        """What is inferred: theta's entries, then the noises that are unknown."""
        return (*self.forward.scene.parameter_names, *self.inferred_noise.values())

    def __call__(self, data: jax.Array | Data | None = None) -> None:
        """The NumPyro program; ``data`` by name, or as it is when one thing is observed."""
        scene = self.forward.scene
        theta = jnp.stack(
            [numpyro.sample(name, self.prior[name]) for name in scene.parameter_names]
        )
        prediction = self.forward.evaluate(theta)
        # Where the forward map has no answer, the density is zero, not NaN.
        numpyro.factor("valid", jnp.where(prediction.valid, 0.0, -jnp.inf))
        sds = self.noise_sds(
            {
                site: numpyro.sample(site, dist.HalfNormal(self.noise[name].sd_scale))
                for name, site in self.inferred_noise.items()
            }
        )
        means = self.observe(jnp.where(prediction.valid, prediction.displacement, 0.0))
        observed = None if data is None else self.observe.name(data, "data")
        for name, mean in means.items():
            numpyro.sample(
                f"observed_{name}",
                dist.Normal(mean, sds[name]).to_event(mean.ndim),
                obs=None if observed is None else observed[name],
            )

    def noise_sds(self, draw: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
        """Standard deviation of each observation's noise: known, or from ``draw`` by its name."""
        inferred = self.inferred_noise
        return {
            name: draw[inferred[name]] if name in inferred else jnp.asarray(noise.sd)
            for name, noise in self.noise.items()
        }

    def log_likelihood(
        self, displacement: jax.Array, sds: Mapping[str, jax.Array], data: Data
    ) -> jax.Array:
        """Log density of ``data`` given the displacement (k, 3) of the observed nodes, shape ()."""
        means = self.observe(displacement)
        terms = [
            jnp.sum(dist.Normal(means[name], sds[name]).log_prob(data[name])) for name in means
        ]
        return sum(terms, jnp.zeros(()))

    def check_data(self, data: np.ndarray | Mapping[str, np.ndarray]) -> dict[str, jax.Array]:
        """``data`` in float64 by name; :class:`InputError` on a wrong shape or value."""
        named = self.observe.name(data, "data")
        return {name: self._checked(name, values) for name, values in named.items()}

    def _checked(self, name: str, data: np.ndarray) -> jax.Array:
        part = self.observe.parts[name]
        values = np.asarray(data, dtype=float)
        if values.shape != part.shape:
            raise InputError(
                f"data has shape {values.shape}; the observation expects {part.shape}"
                f" ({name}, {part.unit})"
            )
        if not np.isfinite(values).all():
            if not values.ndim:
                raise InputError(f"data: {name} is {values}; it must be finite")
            row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
            raise InputError(f"data: row {row} has a value that is not finite; remove that point")
        if part.quantity == "volume" and not values > 0.0:
            raise InputError(f"data: {name} is {values} mL; it must be above 0")
        return jnp.asarray(values)


def model(
    forward: ForwardMap,
    observe: Observation | Mapping[str, Observation] | Observations,
    noise: GaussianNoise | Mapping[str, GaussianNoise],
    prior: Prior | None = None,
) -> Model:
    """The model of data observed through ``observe``.

    Parameters
    ----------
    observe : one observation, or several by name, e.g. ``{"displacement": ..., "volume": ...}``;
        noise and data are then given by the same names.
    prior : the scene's box by default.
    """
    scene = forward.scene
    prior = box_prior(scene) if prior is None else check_prior(scene, prior)
    several = observations(observe)
    noises = several.name(noise, "noise")
    return Model(forward.at(several.nodes), forward, several, noises, prior)
