"""The model of some observations, from a forward map, noise and priors, checked together."""

from __future__ import annotations

from collections.abc import Mapping

from calibrate.measurements import Observation, Observations, observations
from calibrate.noise import Noise
from calibrate.priors import Prior, dependence_of
from calibrate.statistical_model.load_states import load_states
from calibrate.statistical_model.model import Model, at_sites
from calibrate.statistical_model.prior_range import check_known, fit_to
from emulator.core.errors import InputError
from emulator.surrogates.protocol import ForwardMap


def model(
    forward: ForwardMap,
    observe: Observation | Mapping[str, Observation] | Observations,
    noise: Noise | Mapping[str, Noise],
    prior: Prior | None = None,
    *,
    known: Mapping[str, float] | None = None,
    check_scale: bool = True,
) -> Model:
    """The model of data observed through ``observe``.

    Parameters
    ----------
    observe : one observation, or several by name, e.g. ``{"displacement": ..., "volume": ...}``;
        noise and data are then given by the same names. ``volume@p8`` is the volume in the load
        state ``p8``; a noise under ``volume`` is that of every state.
    prior : of parameters by name; the others have the scene's box. In several load states, the
        loads' parameters have one prior for each state, or separate ones under ``pressure@p8``. A
        :class:`~calibrate.priors.JointPrior` correlates some.
    known : parameters that are not inferred, by the same names.
    check_scale : ``False`` to take data however far from every prediction
        (:mod:`calibrate.measurements.magnitude`).

    Raises
    ------
    InputError
        Noise that does not fit its observation, a prior that does not fit the scene, or one with
        more than a thousandth of its mass where the forward map has no answer
        (:mod:`calibrate.statistical_model.prior_range`).
    """
    several = observations(observe)
    names, noises = _noises(several, noise)
    noises = at_sites(noises, several)
    restricted = forward.at(several.nodes)
    states, given = load_states(forward.scene, several.states, prior, known)
    check_known(restricted, states)
    fitting, cut = fit_to(restricted, given)
    dependence = dependence_of(prior)
    joint = None if dependence is None else dependence.ordered(states.unknowns)
    return Model(
        restricted,
        forward,
        several,
        noises,
        names,
        states,
        fitting,
        prior_cut=cut,
        check_scale=check_scale,
        dependence=joint,
    )


def _noises(
    observe: Observations, noise: Noise | Mapping[str, Noise]
) -> tuple[dict[str, str], dict[str, Noise]]:
    """The name each observation's noise was given under, and the noise."""
    if not isinstance(noise, Mapping):
        if len(observe.bases) > 1:
            raise InputError(f"noise: give one for each of {', '.join(observe.bases)}, by name")
        noise = {observe.bases[0]: noise}
    found = observe.expand(noise, "noise")
    for name in observe.parts:
        if name not in found:
            raise InputError(f"noise: nothing for '{name}'; observed: {', '.join(observe.parts)}")
    return {k: source for k, (source, _) in found.items()}, {k: n for k, (_, n) in found.items()}
