r"""The statistical model around a forward map.

.. math:: y_j = \mathcal{O}_j\,u(\theta) + \varepsilon_j

for each observation, with theta from its prior. The noise :math:`\varepsilon_j` of each observation
has a distribution of its own (:mod:`calibrate.noise`), whose unknown numbers have priors too. The
model does not know whether the forward map is the emulator, the emulator with a correction, a
reduced model or FEM.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

from calibrate.magnitude import PRIOR_DRAWS, check_magnitudes
from calibrate.noise import Noise
from calibrate.observations import Observation, Observations, observations
from calibrate.prior_range import fit_to, standardised
from calibrate.priors import Prior, box_prior, check_prior
from emulator.surrogates.protocol import ForwardMap

Data = Mapping[str, jax.Array]
"""Data by the observation's name; each of the observation's shape and unit."""

NoiseValues = Mapping[str, Mapping[str, jax.Array]]
"""Inferred numbers of each observation's noise: observation to number's name to value."""


@dataclass(frozen=True, eq=False)
class Model:
    """A NumPyro model: call it with the data. :func:`model` makes it.

    Parameters
    ----------
    forward : map restricted to the observed nodes.
    full : the same map over all nodes.
    observe : what of the displacement was measured, by name.
    noise : noise of each observation.
    prior : one distribution a parameter.
    prior_cut : parameter to the mass of its prior that was cut off (:mod:`calibrate.prior_range`).
    check_scale : whether :meth:`check_data` refuses data far from every prediction.
    """

    forward: ForwardMap
    full: ForwardMap
    observe: Observations
    noise: Mapping[str, Noise]
    prior: Prior
    prior_cut: Mapping[str, float] = field(default_factory=dict)
    check_scale: bool = True

    @property
    def noise_sites(self) -> dict[str, dict[str, str]]:
        """Observation to the unknown numbers of its noise, each with its name in the posterior.

        ``noise_sd`` when one thing is observed, ``noise_sd_<observation>`` when several are.
        """
        alone = len(self.noise) == 1
        return {
            name: {number: number if alone else f"{number}_{name}" for number in noise.priors}
            for name, noise in self.noise.items()
        }

    @property
    def names(self) -> tuple[str, ...]:
        """What is inferred: theta's entries, then the unknown numbers of the noises."""
        inferred = [site for sites in self.noise_sites.values() for site in sites.values()]
        return (*self.forward.scene.parameter_names, *inferred)

    @cached_property
    def _sampled_prior(self) -> dict[str, dist.Distribution]:
        return {name: standardised(self.prior[name]) for name in self.forward.scene.parameter_names}

    def __call__(self, data: jax.Array | Data | None = None) -> None:
        """The NumPyro program; ``data`` by name, or as it is when one thing is observed."""
        theta = jnp.stack([numpyro.sample(name, d) for name, d in self._sampled_prior.items()])
        prediction = self.forward.evaluate(theta)
        # Where the forward map has no answer, the density is zero, not NaN.
        numpyro.factor("valid", jnp.where(prediction.valid, 0.0, -jnp.inf))
        values = {
            name: {
                number: numpyro.sample(site, self.noise[name].priors[number])
                for number, site in sites.items()
            }
            for name, sites in self.noise_sites.items()
        }
        means = self.observe(jnp.where(prediction.valid, prediction.displacement, 0.0))
        observed = None if data is None else self.observe.name(data, "data")
        for name, mean in means.items():
            numpyro.sample(
                f"observed_{name}",
                self.noise[name].distribution(mean, values[name]),
                obs=None if observed is None else observed[name],
            )

    def noise_values(self, draw: Mapping[str, jax.Array]) -> dict[str, dict[str, jax.Array]]:
        """The inferred numbers of each observation's noise, from ``draw`` by the names there."""
        return {
            name: {number: jnp.asarray(draw[site]) for number, site in sites.items()}
            for name, sites in self.noise_sites.items()
        }

    def log_likelihood(self, displacement: jax.Array, values: NoiseValues, data: Data) -> jax.Array:
        """Log density of ``data`` given the displacement (k, 3) of the observed nodes, shape ()."""
        means = self.observe(displacement)
        terms = [
            self.noise[name].distribution(mean, values[name]).log_prob(data[name])
            for name, mean in means.items()
        ]
        return sum(terms, jnp.zeros(()))

    def prior_thetas(self, key: jax.Array, count: int) -> jax.Array:
        """Theta (count, p) from the prior."""
        names = self.forward.scene.parameter_names
        keys = jax.random.split(key, len(names))
        draws = [self.prior[n].sample(k, (count,)) for n, k in zip(names, keys, strict=True)]
        return jnp.stack(draws, axis=1)

    def check_data(self, data: np.ndarray | Mapping[str, np.ndarray]) -> dict[str, jax.Array]:
        """``data`` in float64 by name; :class:`InputError` on data that cannot be the model's."""
        named = {
            name: np.asarray(values, dtype=float)
            for name, values in self.observe.name(data, "data").items()
        }
        for name, values in named.items():
            self.observe.parts[name].check(name, values)
        if self.check_scale:
            thetas = np.asarray(self.prior_thetas(jax.random.key(0), PRIOR_DRAWS))
            check_magnitudes(self.forward, self.observe, self.noise, thetas, named)
        return {name: jnp.asarray(values) for name, values in named.items()}


def model(
    forward: ForwardMap,
    observe: Observation | Mapping[str, Observation] | Observations,
    noise: Noise | Mapping[str, Noise],
    prior: Prior | None = None,
    *,
    check_scale: bool = True,
) -> Model:
    """The model of data observed through ``observe``.

    Parameters
    ----------
    observe : one observation, or several by name, e.g. ``{"displacement": ..., "volume": ...}``;
        noise and data are then given by the same names.
    prior : the scene's box by default.
    check_scale : ``False`` to take data however far from every prediction
        (:mod:`calibrate.magnitude`).

    Raises
    ------
    InputError
        A prior that does not fit the scene, or with more than a thousandth of its mass where the
        forward map has no answer (:mod:`calibrate.prior_range`).
    """
    scene = forward.scene
    several = observations(observe)
    noises = several.name(noise, "noise")
    restricted = forward.at(several.nodes)
    given = box_prior(scene) if prior is None else check_prior(scene, prior)
    prior, cut = fit_to(restricted, given)
    return Model(restricted, forward, several, noises, prior, cut, check_scale)
