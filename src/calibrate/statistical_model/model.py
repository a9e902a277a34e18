r"""The statistical model around a forward map.

.. math:: y_{sj} = \mathcal{O}_j\,u(\theta_s) + (V^T z)_{sj} + \varepsilon_{sj}

for each observation j in each load state s, with the unknowns of :math:`\theta_s` from their priors
(:mod:`~calibrate.statistical_model.load_states`). The noise :math:`\varepsilon_{sj}` of each
observation has a distribution of its own (:mod:`calibrate.noise`), whose unknown scales have priors
too. Errors :math:`V^T z` that correlate numbers, if there are any, are integrated out
(:mod:`calibrate.model_error`). The model does not know whether the forward map is the emulator, the
emulator with a correction, a reduced model or FEM.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax.flatten_util import ravel_pytree

from calibrate import mend_numpyro
from calibrate.measurements import Observation, Observations, leave_out_missing, observations
from calibrate.measurements.collection import in_every_state
from calibrate.measurements.magnitude import PRIOR_DRAWS, check_magnitudes, predict_over_prior
from calibrate.model_error import ModelError
from calibrate.noise import Noise
from calibrate.priors import Dependence, Prior, dependence_of
from calibrate.priors.priors import Conditional
from calibrate.state_names import split
from calibrate.statistical_model.load_states import LoadStates, boxed, load_states
from calibrate.statistical_model.many_draws import means_at_rows
from calibrate.statistical_model.prior_range import check_known, fit_to, standardised
from emulator.core.errors import InputError
from emulator.core.kept import kept
from emulator.scenes.parameter_space import Parameter
from emulator.surrogates.correction import correction_at
from emulator.surrogates.protocol import ForwardMap, Prediction, fingerprint_of
from emulator.surrogates.taught import DataProcess

mend_numpyro()

Data = Mapping[str, jax.Array]
"""Data by the observation's name; each of the observation's shape and unit."""

_GROUP = "observed_data"  # group of a posterior's DataTree


@dataclass(frozen=True, eq=False)
class Model:
    """A NumPyro model: call it with the data. :func:`model` makes it.

    forward : the forward map, restricted to the observed nodes.
    full : the same map over all nodes.
    observe : the observations by name.
    noise : the noise of each observation.
    noise_names : the name under which each observation's noise was given; observations with one
        name share its unknown scales.
    states : the source of each entry of theta in each load state.
    prior : the prior of each unknown of theta.
    error : systematic errors of the data, besides noise.
    prior_cut : the mass of each prior that was cut off, by unknown (``prior_range``).
    check_scale : whether :meth:`check_data` refuses data far from every prediction.
    dependence : the dependence between the priors of some unknowns, in theta's order.
    boxed : the unknowns whose prior is the scene's range for lack of another one, so that its ends
        may be a guess (:mod:`calibrate.posterior.box`).
    """

    forward: ForwardMap
    full: ForwardMap
    observe: Observations
    noise: Mapping[str, Noise]
    noise_names: Mapping[str, str]
    states: LoadStates
    prior: Prior
    error: ModelError = field(default_factory=ModelError)
    prior_cut: Mapping[str, float] = field(default_factory=dict)
    check_scale: bool = True
    dependence: Dependence | None = None
    boxed: frozenset[str] = frozenset()

    # What is inferred, and its prior.

    @cached_property
    def noise_sites(self) -> dict[str, dict[str, str]]:
        """Name in the posterior of each unknown scale, by observation and the scale's name.

        ``noise_sd`` when one thing is observed, ``noise_sd_<observation>`` when several are.
        """
        alone = len(set(self.noise_names.values())) == 1
        return {
            name: {
                scale: scale if alone else f"{scale}_{self.noise_names[name]}"
                for scale in noise.priors
            }
            for name, noise in self.noise.items()
        }

    @cached_property
    def noise_priors(self) -> dict[str, dist.Distribution]:
        """Prior of every unknown scale of noises and errors, by its name in the posterior."""
        noises = {
            site: self.noise[name].priors[scale]
            for name, sites in self.noise_sites.items()
            for scale, site in sites.items()
        }
        return noises | self.error.priors

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all that is inferred: unknowns of theta, then scales of noises and errors."""
        return (*self.states.unknowns, *self.noise_priors)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameter of its scene that each unknown of theta is, in one load state or in all."""
        named = {parameter.name: parameter for parameter in self.forward.scene.parameters}
        return tuple(named[split(name)[0]] for name in self.states.unknowns)

    @cached_property
    def on_log_scale(self) -> np.ndarray:
        """Flags (q,) that say which unknowns of theta have a logarithmic scale in their scene."""
        return np.array([parameter.scale == "log" for parameter in self.parameters], dtype=bool)

    def on_scales(self, theta: jax.Array | np.ndarray) -> jax.Array:
        """Return unknowns (..., q) of theta, as logarithms where their parameter's scale is log."""
        log = self.on_log_scale
        return jnp.where(log, jnp.log(jnp.where(log, theta, 1.0)), theta)

    def from_scales(self, x: jax.Array) -> jax.Array:
        """Return the inverse of :meth:`on_scales`."""
        log = self.on_log_scale
        return jnp.where(log, jnp.exp(jnp.where(log, x, 0.0)), x)

    @property
    def box(self) -> dict[str, Parameter]:
        """The parameter of each of :attr:`boxed`, in theta's order."""
        named = zip(self.states.unknowns, self.parameters, strict=True)
        return {name: parameter for name, parameter in named if name in self.boxed}

    @cached_property
    def sampled_priors(self) -> dict[str, dist.Distribution]:
        """Prior of all that is inferred, as NumPyro samples it, but for the dependence."""
        theta = {name: standardised(self.prior[name]) for name in self.states.unknowns}
        return {**theta, **self.noise_priors}

    def given_earlier(
        self, name: str, prior: dist.Distribution, draw: Mapping[str, jax.Array]
    ) -> dist.Distribution:
        """Return ``prior`` of ``name``, conditional on the unknowns before it in ``draw``."""
        if self.dependence is None or name not in self.dependence.names:
            return prior
        mean, sd = self.dependence.given_earlier(name, self.prior, draw)
        return Conditional(self.prior[name], mean, sd, prior.support)

    def prior_draws(self, key: jax.Array, count: int) -> dict[str, jax.Array]:
        """Return draws (count,) from the prior of each unknown of theta."""
        keys = jax.random.split(key, len(self.states.unknowns))
        draws: dict[str, jax.Array] = {}
        for name, k in zip(self.states.unknowns, keys, strict=True):
            draws[name] = self.given_earlier(name, self.prior[name], draws).sample(k, (count,))
        return draws

    def log_prior(self, values: Mapping[str, jax.Array]) -> jax.Array:
        """Return the log prior density, (), of those unknowns of theta that ``values`` has."""
        log_density = jnp.zeros(())
        for name in filter(values.__contains__, self.states.unknowns):
            prior = self.given_earlier(name, self.prior[name], values)
            log_density += prior.log_prob(values[name])
        return log_density

    def draw_unknowns(self) -> dict[str, jax.Array]:
        """Sample all that is inferred from its prior, as a NumPyro program; return it by name."""
        draw: dict[str, jax.Array] = {}
        for name, prior in self.sampled_priors.items():
            draw[name] = numpyro.sample(name, self.given_earlier(name, prior, draw))
        return draw

    # The likelihood.

    def __call__(self, data: jax.Array | Data | None = None) -> None:
        """Run as a NumPyro program; ``data`` by name, or as they are if one thing is observed."""
        draw = self.draw_unknowns()
        means, valid = self.predict(draw)
        # Where the forward map has no answer, the density is zero, not NaN.
        numpyro.factor("valid", jnp.where(valid, 0.0, -jnp.inf))
        observed = None if data is None else self.observe.name(data, "data")
        if self.error.terms:
            if observed is None:
                means = self.means_with_errors(numpyro.prng_key(), draw, means)
            else:
                numpyro.factor("error", self._log_ratio(draw, means, observed))
        for name, distribution in self.distributions(draw, means).items():
            obs = None if observed is None else observed[name]
            numpyro.sample(f"observed_{name}", distribution, obs=obs)

    def means(
        self, thetas: jax.Array, prediction: Prediction | None = None
    ) -> tuple[dict[str, jax.Array], jax.Array]:
        """Return data without noise by observation, 0 where it is not valid, and its validity.

        thetas : theta in every load state, (S, p).
        prediction : the result of :meth:`evaluate` there, where it is known already.
        """
        if prediction is None or self._process is not None:
            return self._through(thetas)
        displacement, valid = prediction
        return self.observe(jnp.where(valid, displacement, 0.0), thetas), valid

    @cached_property
    def _through(self) -> Callable[[jax.Array], tuple[dict[str, jax.Array], jax.Array]]:
        """The data that the map predicts, as a function of theta in every load state."""
        if (process := self._process) is None:
            return self.observe.through(self.full)
        unravel = self.observe.unravel
        space = self.forward.scene.space

        def data(thetas: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
            valid = jnp.all(space.contains(thetas))
            x = self.on_scales(self.states.values(thetas))
            flat = process.constant + correction_at(process.correction, x)
            return unravel(jnp.where(valid, flat, 0.0)), valid

        return data

    @cached_property
    def _process(self) -> DataProcess | None:
        """The process of these data in place of the map's displacement, where the map has one."""
        data_of = getattr(self.full, "data_of", None)
        return None if data_of is None else data_of(self.question)

    @cached_property
    def question(self) -> str:
        """Short hash of what is observed, and of the unknowns that it follows from."""
        words = [self.observe.to_json(), self.states.to_json(), self.on_log_scale.tolist()]
        return fingerprint_of(json.dumps(words))

    def evaluate(self, thetas: jax.Array) -> Prediction:
        """Return the displacement (S, k, 3) mm of the observed nodes at ``thetas`` (S, p)."""
        return in_every_state(self.forward, thetas)

    def predict(self, values: Mapping[str, Any]) -> tuple[dict[str, jax.Array], jax.Array]:
        """Return data without noise by observation, and its validity, from each unknown's value."""
        return self.means(self.states.thetas(values))

    def predict_stacked(self, values: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        """Return :meth:`predict` of values (q,) in the order of the unknowns."""
        return self.predict(dict(zip(self.states.unknowns, values, strict=True)))

    def distributions(self, draw: Mapping[str, Any], means: Data) -> dict[str, dist.Distribution]:
        """Return the distribution of each observation's data around its mean, by name.

        ``draw`` has the inferred scales of the noises, by their names in the posterior.
        """
        scales = {
            name: {scale: jnp.asarray(draw[site]) for scale, site in sites.items()}
            for name, sites in self.noise_sites.items()
        }
        return {n: self.noise[n].distribution(mean, scales[n]) for n, mean in means.items()}

    def log_density(self, draw: Mapping[str, Any], means: Data, data: Data) -> jax.Array:
        """Return the log density of ``data`` around ``means`` with noise alone, ()."""
        parts = self.distributions(draw, means)
        return sum((d.log_prob(data[name]) for name, d in parts.items()), jnp.zeros(()))

    def log_likelihood(self, draw: Mapping[str, Any], means: Data, data: Data) -> jax.Array:
        """Return the log density of ``data``, (), around ``means`` with noise and errors."""
        return self.log_density(draw, means, data) + self._log_ratio(draw, means, data)

    def means_with_errors(
        self, rng_key: jax.Array, draw: Mapping[str, Any], means: Data
    ) -> dict[str, jax.Array]:
        """Return ``means`` plus a draw of the errors, of the size that ``draw`` has."""
        return self.error.draw(rng_key, self._error_size(draw), means)

    def map_log_likelihood(self, draw: Mapping[str, Any], data: Data) -> jax.Array:
        """Return the log density of ``data``, (), around what the forward map predicts.

        It is ``-inf`` where the map has no answer. ``draw`` has a number for each of :attr:`names`.
        """
        means, valid = self.predict(draw)
        return jnp.where(valid, self.log_likelihood(draw, means, data), -jnp.inf)

    def _log_ratio(self, draw: Mapping[str, Any], means: Data, data: Data) -> jax.Array:
        residual = {name: data[name] - mean for name, mean in means.items()}
        return self.error.log_ratio(self._error_size(draw), residual, means)

    def _error_size(self, draw: Mapping[str, Any]) -> Any:
        """Return the size of errors in ``draw``, 1 where none is inferred."""
        return next((draw[name] for name in self.error.priors), 1.0)

    # Its data.

    def given(
        self, data: np.ndarray | Mapping[str, np.ndarray]
    ) -> tuple[Model, dict[str, jax.Array]]:
        """Return the model of the values that are not missing (NaN), and these values after checks.

        :class:`InputError` as :meth:`check_data`, or where every value of an observation is
        missing.
        """
        observe, present = leave_out_missing(self.observe, self._fitting(data))
        if observe is self.observe:
            return self, self.check_data(present)
        if self.error.terms:
            raise InputError(
                "the model's error is for data without missing values; give it to the model that "
                "Model.given makes"
            )
        reduced = replace(self, observe=observe, noise=at_sites(self.noise, observe))
        return reduced, reduced.check_data(present)

    def check_data(self, data: np.ndarray | Mapping[str, np.ndarray]) -> dict[str, jax.Array]:
        """Return ``data`` in float64 by name; :class:`InputError` if they cannot be the model's."""
        named = self._fitting(data)
        for name, values in named.items():
            if np.isnan(values).any():
                raise InputError(
                    f"data: {int(np.isnan(values).sum())} of {values.size} values of {name} are "
                    "missing (NaN); Model.given leaves them out"
                )
        if self.check_scale:
            draws, predictions = _before_data(self)
            predict, sds = self.predict_stacked, self._largest_sds(named)
            check_magnitudes(predict, self.observe, sds, draws, named, predictions)
        return {name: jnp.asarray(values) for name, values in named.items()}

    def _largest_sds(self, data: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the largest plausible sd of each observation by noise and errors, in its unit."""
        sds = {name: noise.upper_sd for name, noise in self.noise.items()}
        like = {name: jnp.asarray(values) for name, values in data.items()}
        rows = jnp.asarray(self.error.largest(like))
        for name, modes in jax.vmap(ravel_pytree(like)[1])(rows).items() if len(rows) else ():
            largest = np.linalg.norm(np.reshape(modes, (len(modes), -1)), 2)
            sds[name] = float(np.hypot(sds[name], largest))
        return sds

    def _fitting(self, data: np.ndarray | Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return ``data`` in float64 by name, of the right shapes; NaN where missing.

        A number may be an array of one, and ``data`` a DataTree whose group has what was observed.
        """
        if isinstance(data, Mapping) and _GROUP in data and _GROUP not in self.observe.parts:
            data = data[_GROUP]
        named = {
            name: np.asarray(values, dtype=float)
            for name, values in self.observe.name(data, "data").items()
        }
        for name, shape in self.observe.shapes.items():
            if shape == () and named[name].shape == (1,):
                named[name] = named[name].reshape(())
            self.observe.check(name, named[name])
        return named


@kept
def _before_data(model: Model) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return draws (c, q) of the unknowns' prior, and predictions over it, by observation."""
    draws = jax.jit(lambda key: model.prior_draws(key, PRIOR_DRAWS))(jax.random.key(0))
    stacked = np.stack([np.asarray(draws[name]) for name in model.states.unknowns], axis=1)
    return stacked, predict_over_prior(partial(means_at_rows, model), model.observe, stacked)


def model(
    forward: ForwardMap,
    observe: Observation | Mapping[str, Observation] | Observations,
    noise: Noise | Mapping[str, Noise],
    prior: Prior | None = None,
    *,
    known: Mapping[str, float] | None = None,
    bounded: Collection[str] = (),
    check_scale: bool = True,
) -> Model:
    """Return the model of data observed through ``observe``.

    Parameters
    ----------
    observe : one observation, or several by name, e.g. ``{"displacement": ..., "volume": ...}``;
        noise and data are then given by the same names. ``volume@p8`` is the volume in the load
        state ``p8``; a noise under ``volume`` is that of every state.
    prior : priors of parameters by name; the others have the scene's box. In several load states,
        the loads' parameters have one prior for each state, or separate ones under ``pressure@p8``.
        A :class:`~calibrate.priors.JointPrior` correlates some.
    known : values of parameters that are not inferred, by the same names.
    bounded : parameters whose range ends where nature does. The posterior of another one without a
        prior carries a warning where it ends at the range's end.
    check_scale : ``False`` to take data however far from every prediction
        (:mod:`calibrate.measurements.magnitude`).

    Raises
    ------
    InputError
        Noise that does not fit its observation, a bounded parameter that is not inferred, a prior
        that does not fit the scene, or one with more than a thousandth of its mass where the
        forward map has no answer (:mod:`calibrate.statistical_model.prior_range`).
    """
    several = observations(observe)
    if not isinstance(noise, Mapping):
        if len(several.bases) > 1:
            raise InputError(f"noise: give one for each of {', '.join(several.bases)}, by name")
        noise = {several.bases[0]: noise}
    expanded = several.expand(noise, "noise")
    for name in several.parts:
        if name not in expanded:
            raise InputError(f"noise: nothing for '{name}'; observed: {', '.join(several.parts)}")
    restricted = forward.at(several.nodes)
    states, priors = load_states(forward.scene, several.states, prior, known)
    check_known(restricted, states)
    cut_priors, cut = fit_to(restricted, priors)
    dependence = dependence_of(prior)
    return Model(
        forward=restricted,
        full=forward,
        observe=several,
        noise=at_sites({name: noise_model for name, (_, noise_model) in expanded.items()}, several),
        noise_names={name: source for name, (source, _) in expanded.items()},
        states=states,
        prior=cut_priors,
        prior_cut=cut,
        check_scale=check_scale,
        dependence=None if dependence is None else dependence.ordered(states.unknowns),
        boxed=boxed(states, prior, bounded),
    )


def at_sites(noise: Mapping[str, Noise], observe: Observations) -> dict[str, Noise]:
    """Return each noise at the sites of its observation; InputError names the observation."""
    bound = {}
    for name in observe.parts:
        try:
            bound[name] = noise[name].at(observe.sites(name))
        except InputError as error:
            raise InputError(f"noise of {name}: {error}") from error
    return bound
