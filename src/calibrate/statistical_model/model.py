r"""The statistical model around a forward map.

.. math:: y_{sj} = \mathcal{O}_j\,u(\theta_s) + \varepsilon_{sj}

for each observation j in each load state s, with the unknowns of :math:`\theta_s` from their priors
(``load_states``). The noise :math:`\varepsilon_{sj}` of each observation has a distribution of its
own (:mod:`calibrate.noise`), whose unknown numbers have priors too. The model does not know whether
the forward map is the emulator, the emulator with a correction, a reduced model or FEM.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax.flatten_util import ravel_pytree
from numpyro import handlers

from calibrate.measurements import Observations
from calibrate.measurements.magnitude import PRIOR_DRAWS, check_magnitudes
from calibrate.measurements.present import leave_out_missing
from calibrate.noise import Noise
from calibrate.priors import Prior
from calibrate.priors.joint_prior import Conditional, Dependence
from calibrate.state_names import split
from calibrate.statistical_model.error_modes import ErrorModes
from calibrate.statistical_model.load_states import LoadStates
from calibrate.statistical_model.prior_range import standardised
from calibrate.whole_numpyro import mend_numpyro
from emulator.core.errors import InputError
from emulator.surrogates.protocol import ForwardMap, Prediction

mend_numpyro()

Data = Mapping[str, jax.Array]
"""Data by the observation's name; each of the observation's shape and unit."""

_GROUP = "observed_data"  # of a posterior's DataTree

NoiseValues = Mapping[str, Mapping[str, jax.Array]]
"""Inferred numbers of each observation's noise: observation to number's name to value."""


@dataclass(frozen=True, eq=False)
class Model:
    """A NumPyro model: call it with the data. :func:`model` makes it.

    Parameters
    ----------
    forward : map restricted to the observed nodes.
    full : the same map over all nodes.
    observe : what was measured, by name.
    noise : noise of each observation.
    noise_names : the name each observation's noise was given under; observations with one name
        share its unknown numbers.
    states : where theta comes from in each load state.
    prior : one distribution an unknown of theta.
    error : what the likelihood allows for besides noise: the forward map's own error, or systematic
        ones of the measurement.
    prior_cut : unknown to the mass of its prior that was cut off (``prior_range``).
    check_scale : whether :meth:`check_data` refuses data far from every prediction.
    dependence : of the prior of some unknowns of theta, in theta's order.
    """

    forward: ForwardMap
    full: ForwardMap
    observe: Observations
    noise: Mapping[str, Noise]
    noise_names: Mapping[str, str]
    states: LoadStates
    prior: Prior
    error: ErrorModes | None = None
    prior_cut: Mapping[str, float] = field(default_factory=dict)
    check_scale: bool = True
    dependence: Dependence | None = None

    @cached_property
    def noise_sites(self) -> dict[str, dict[str, str]]:
        """Observation to the unknown numbers of its noise, each with its name in the posterior.

        ``noise_sd`` when one thing is observed, ``noise_sd_<observation>`` when several are.
        """
        alone = len(set(self.noise_names.values())) == 1
        return {
            name: {
                number: number if alone else f"{number}_{self.noise_names[name]}"
                for number in noise.priors
            }
            for name, noise in self.noise.items()
        }

    @cached_property
    def noise_priors(self) -> dict[str, dist.Distribution]:
        """Prior of every unknown number of noises and error, by its name in the posterior."""
        noises = {
            site: self.noise[name].priors[number]
            for name, sites in self.noise_sites.items()
            for number, site in sites.items()
        }
        return noises if self.error is None else {**noises, **self.error.priors}

    @property
    def names(self) -> tuple[str, ...]:
        """What is inferred: the unknowns of theta, then those of noises and error."""
        return (*self.states.unknowns, *self.noise_priors)

    @property
    def on_log_scale(self) -> tuple[bool, ...]:
        """Whether each unknown of theta has a logarithmic scale in its scene."""
        scales = {parameter.name: parameter.scale for parameter in self.forward.scene.parameters}
        return tuple(scales[split(name)[0]] == "log" for name in self.states.unknowns)

    @cached_property
    def sampled_priors(self) -> dict[str, dist.Distribution]:
        """Prior of all that is inferred, as NumPyro samples it, but for the dependence."""
        theta = {name: standardised(self.prior[name]) for name in self.states.unknowns}
        return {**theta, **self.noise_priors}

    def __call__(
        self, data: jax.Array | Data | None = None, prediction: Prediction | None = None
    ) -> None:
        """The NumPyro program; ``data`` by name, or as it is when one thing is observed.

        ``prediction`` of :meth:`evaluate` at the drawn theta, where it is known already.
        """
        draw: dict[str, jax.Array] = {}
        for name, prior in self.sampled_priors.items():
            draw[name] = numpyro.sample(name, self.given_earlier(name, prior, draw))
        thetas = self.states.thetas(draw)
        prediction = self.evaluate(thetas) if prediction is None else prediction
        # Where the forward map has no answer, the density is zero, not NaN.
        numpyro.factor("valid", jnp.where(prediction.valid, 0.0, -jnp.inf))
        means = self.observe(jnp.where(prediction.valid, prediction.displacement, 0.0), thetas)
        observed = None if data is None else self.observe.name(data, "data")
        if self.error is not None:
            if observed is None:
                means = self.error.draw(numpyro.prng_key(), self._stacked(draw), means)
            else:
                numpyro.factor("error", self._error_ratio(draw, means, observed))
        for name, distribution in self.distributions(means, self.noise_values(draw)).items():
            obs = None if observed is None else observed[name]
            numpyro.sample(f"observed_{name}", distribution, obs=obs)

    def given_earlier(
        self, name: str, prior: dist.Distribution, draw: Mapping[str, jax.Array]
    ) -> dist.Distribution:
        """``prior`` of ``name``, given the unknowns before it that it depends on."""
        if self.dependence is None or name not in self.dependence.names:
            return prior
        mean, sd = self.dependence.given_earlier(name, self.prior, draw)
        return Conditional(self.prior[name], mean, sd, prior.support)

    def evaluate(self, thetas: jax.Array) -> Prediction:
        """Displacement (S, k, 3) mm of the observed nodes at ``thetas`` (S, p), in one call.

        It is valid where the forward map is valid in every state.
        """
        if len(thetas) == 1:
            displacement, valid = self.forward.evaluate(thetas[0])
            return Prediction(displacement[None], valid)
        displacement, valid = jax.vmap(self.forward.evaluate)(thetas)
        return Prediction(displacement, jnp.all(valid))

    def predict(self, values: Mapping[str, Any]) -> tuple[dict[str, jax.Array], jax.Array]:
        """Data without noise by observation, and its validity, from a value of each unknown."""
        thetas = self.states.thetas(values)
        prediction = self.evaluate(thetas)
        return self.observe(prediction.displacement, thetas), prediction.valid

    def noise_values(self, draw: Mapping[str, jax.Array]) -> dict[str, dict[str, jax.Array]]:
        """The inferred numbers of each observation's noise, from ``draw`` by the names there."""
        return {
            name: {number: jnp.asarray(draw[site]) for number, site in sites.items()}
            for name, sites in self.noise_sites.items()
        }

    def distributions(self, means: Data, values: NoiseValues) -> dict[str, dist.Distribution]:
        """Distribution of each observation's data around its mean, by name.

        ``values`` of the inferred numbers of the noises (:meth:`noise_values`).
        """
        return {n: self.noise[n].distribution(mean, values[n]) for n, mean in means.items()}

    def log_density(self, means: Data, values: NoiseValues, data: Data) -> jax.Array:
        """Log density of ``data`` around ``means``, shape ()."""
        parts = self.distributions(means, values)
        return sum((d.log_prob(data[name]) for name, d in parts.items()), jnp.zeros(()))

    def fem_log_likelihood(self, draw: Mapping[str, Any], means: Data, data: Data) -> jax.Array:
        """Log density of ``data``, (), around FEM's ``means`` at ``draw``.

        Where the likelihood allows for errors of the mesh or of the measurement, FEM has them, too.
        """
        found = self.log_density(means, self.noise_values(draw), data)
        if self.error is not None and self.error.of_fem:
            found += self._error_ratio(draw, means, data)
        return found

    def fem_means(self, rng_key: jax.Array, draw: Mapping[str, Any], means: Data) -> Data:
        """FEM's ``means`` at ``draw``, with a draw of errors that are not the map's alone."""
        if self.error is None or not self.error.of_fem:
            return means
        return self.error.draw(rng_key, self._stacked(draw), means)

    def map_log_likelihood(self, draw: Mapping[str, Any], data: Data) -> jax.Array:
        """Log density of ``data``, (), with the forward map and what is allowed for its error.

        ``-inf`` where the map has no answer. ``draw`` has a number for each of ``names``.
        """
        observed = [site for site in self.trace(draw, data).values() if site.get("is_observed")]
        return sum((jnp.sum(s["fn"].log_prob(s["value"])) for s in observed), jnp.zeros(()))

    def trace(self, draw: Mapping[str, Any], data: Data) -> dict[str, dict[str, Any]]:
        """The program's sites at ``draw`` (a number by name) and ``data``, as NumPyro has them."""
        return handlers.trace(handlers.substitute(self, data=dict(draw))).get_trace(data)

    def _error_ratio(self, draw: Mapping[str, Any], means: Data, data: Data) -> jax.Array:
        assert self.error is not None
        residual = {name: data[name] - mean for name, mean in means.items()}
        return self.error.log_ratio(self._stacked(draw), residual, means)

    def _stacked(self, draw: Mapping[str, Any]) -> jax.Array:
        own = () if self.error is None else self.error.priors
        names = (*self.states.unknowns, *own)
        return jnp.stack([jnp.asarray(draw[name], float) for name in names])

    def prior_draws(self, key: jax.Array, count: int) -> dict[str, jax.Array]:
        """Draws (count,) from the prior of each unknown of theta."""
        keys = jax.random.split(key, len(self.states.unknowns))
        found: dict[str, jax.Array] = {}
        for name, k in zip(self.states.unknowns, keys, strict=True):
            prior = self.given_earlier(name, self.prior[name], found)
            found[name] = prior.sample(k, (count,))
        return found

    def log_prior(self, values: Mapping[str, jax.Array]) -> jax.Array:
        """Log density of the prior of theta's unknowns, (); ``values`` are numbers by name."""
        found = jnp.zeros(())
        for name in self.states.unknowns:
            prior = self.given_earlier(name, self.prior[name], values)
            found += prior.log_prob(values[name])
        return found

    def given(
        self, data: np.ndarray | Mapping[str, np.ndarray]
    ) -> tuple[Model, dict[str, jax.Array]]:
        """The model of the values that are not missing, and these, checked.

        Missing values are NaN (:mod:`calibrate.measurements.present`).

        Raises
        ------
        InputError
            As :meth:`check_data`, or every value of an observation is missing.
        """
        observe, present = leave_out_missing(self.observe, self._fitting(data))
        if all(part is self.observe.parts[name] for name, part in observe.parts.items()):
            return self, self.check_data(present)
        if self.error is not None:
            raise InputError(
                "the model's error is for data without missing values; give it to the model that "
                "Model.given makes"
            )
        reduced = replace(self, observe=observe, noise=at_sites(self.noise, observe))
        return reduced, reduced.check_data(present)

    def check_data(self, data: np.ndarray | Mapping[str, np.ndarray]) -> dict[str, jax.Array]:
        """``data`` in float64 by name; :class:`InputError` on data that cannot be the model's."""
        named = self._fitting(data)
        for name, values in named.items():
            if np.isnan(values).any():
                raise InputError(
                    f"data: {int(np.isnan(values).sum())} of {values.size} values of {name} are "
                    "missing (NaN); Model.given leaves them out"
                )
        if self.check_scale:
            draws = jax.jit(lambda key: self.prior_draws(key, PRIOR_DRAWS))(jax.random.key(0))
            stacked = np.stack([np.asarray(draws[n]) for n in self.states.unknowns], axis=1)
            check_magnitudes(self._predict_stacked, self.observe, self._sds(named), stacked, named)
        return {name: jnp.asarray(values) for name, values in named.items()}

    def _sds(self, data: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Largest plausible sd of each observation's noise and what else data has, in its unit."""
        found = {name: noise.upper_sd for name, noise in self.noise.items()}
        if self.error is not None and self.error.of_fem:
            like = {name: jnp.asarray(values) for name, values in data.items()}
            each = jax.vmap(ravel_pytree(like)[1])(jnp.asarray(self.error.largest(like)))
            for name, modes in each.items():
                most = np.linalg.norm(np.reshape(modes, (len(modes), -1)), 2)
                found[name] = float(np.hypot(found[name], most))
        return found

    def _fitting(self, data: np.ndarray | Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """``data`` in float64 by name, of the right shapes; NaN where missing.

        A number may be an array of one, and ``data`` a DataTree with what was observed in a group.
        """
        if isinstance(data, Mapping) and _GROUP in data and _GROUP not in self.observe.parts:
            data = data[_GROUP]
        named = {
            name: np.asarray(values, dtype=float)
            for name, values in self.observe.name(data, "data").items()
        }
        for name in [n for n, shape in self.observe.shapes.items() if shape == ()]:
            named[name] = named[name].reshape(()) if named[name].shape == (1,) else named[name]
        for name, values in named.items():
            self.observe.parts[name].check(name, values)
        return named

    def _predict_stacked(self, values: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        return self.predict(dict(zip(self.states.unknowns, values, strict=True)))


def at_sites(noise: Mapping[str, Noise], observe: Observations) -> dict[str, Noise]:
    """Each noise at the sites of its observation; :class:`InputError` names the observation."""
    found = {}
    for name, part in observe.parts.items():
        try:
            found[name] = noise[name].at(part.sites)
        except InputError as error:
            raise InputError(f"noise of {name}: {error}") from error
    return found
