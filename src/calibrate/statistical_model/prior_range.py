r"""Priors against the range in which a forward map answers, and where samplers start.

An emulator answers in its scene's box only: outside it the model's density is zero. A prior wider
than the box would be cut there without a word, and a truth outside the box would pile up at its
edge. So a prior with more than :data:`NEGLIGIBLE` of its mass where the map has no answer is
refused. With less, the prior is cut to the box: its density inside changes by at most that
fraction, and the cut is recorded in the provenance and in reports. Maps that answer anywhere, such
as FEM, take any prior.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax
import numpy as np
import numpyro.distributions as dist
from jax.typing import ArrayLike
from numpyro.distributions import constraints
from numpyro.distributions.transforms import AffineTransform, ComposeTransform, biject_to

from calibrate.priors import Prior, bisect, bounds, truncated
from calibrate.state_names import split
from calibrate.statistical_model.load_states import LoadStates
from emulator.core.errors import InputError
from emulator.scenes.parameter_space import Parameter
from emulator.surrogates.protocol import ForwardMap

NEGLIGIBLE = 1e-3
_ROUND_OFF = 1e-9  # mass that is round-off of a cumulative distribution function
_CENTRED = 1.0  # median of a coordinate on the real line, of which a uniform one is 4 wide
_DRAWS = 512  # draws from which the centre and the width of a prior are estimated


def fit_to(forward: ForwardMap, prior: Prior) -> tuple[Prior, dict[str, float]]:
    """Return ``prior``, cut where ``forward`` has no answer, and the mass cut off, by name.

    A name is a parameter, or a parameter in a load state (:mod:`calibrate.state_names`).

    :class:`InputError` for a prior with more than :data:`NEGLIGIBLE` of its mass where the map has
    no answer.
    """
    cut: dict[str, float] = {}
    for name, distribution in prior.items():
        k = forward.scene.parameter_names.index(split(name)[0])
        parameter = forward.scene.parameters[k]
        tails = dict(_tails(parameter, distribution))
        mass = sum(tails.values())
        if not tails or all(_answers(forward, k, value) for value in tails):
            continue
        if mass > NEGLIGIBLE:
            share = f"{100.0 * mass:{'.2g' if mass < 0.995 else '.4g'}} %"
            raise InputError(
                f"prior of '{name}' has {share} of its mass outside "
                f"{parameter.low:g} to {parameter.high:g} {parameter.unit}".rstrip()
                + f", where forward map '{forward.kind}' has no answer: cut it yourself with "
                "cal.priors.truncated(prior, scene), or use FEM or a scene of wider range"
            )
        cut[name] = mass
    inside = truncated(prior, forward.scene)
    return {name: inside[name] if name in cut else prior[name] for name in prior}, cut


def check_known(forward: ForwardMap, states: LoadStates) -> None:
    """Raise :class:`InputError` where a known value is outside the range of the map's answers."""
    for row in states.entries:
        for k, entry in enumerate(row):
            parameter = forward.scene.parameters[k]
            if isinstance(entry, str) or parameter.low <= entry <= parameter.high:
                continue
            if not _answers(forward, k, entry):
                raise InputError(
                    f"'{parameter.name}' is known to be {entry:g} {parameter.unit}".rstrip()
                    + f"; forward map '{forward.kind}' answers from {parameter.low:g} to "
                    f"{parameter.high:g}: use FEM or a scene of wider range"
                )


def _tails(parameter: Parameter, prior: dist.Distribution) -> Iterator[tuple[float, float]]:
    """Yield median and mass of the prior below the parameter's range and above it, if any."""
    low, high = bounds(prior)
    if parameter.low <= low and high <= parameter.high:
        return
    try:
        below = float(prior.cdf(parameter.low)) if low < parameter.low else 0.0
        above = 1.0 - float(prior.cdf(parameter.high)) if high > parameter.high else 0.0
    except NotImplementedError as error:
        raise InputError(
            f"prior of '{parameter.name}': {type(prior).__name__} has no cumulative distribution "
            "function, so its mass outside the scene's range is unknown; use another one"
        ) from error
    width = parameter.high - parameter.low
    if below > _ROUND_OFF:
        start = max(low, parameter.low - 1e6 * width)
        yield float(bisect(prior.cdf, 0.5 * below, start, parameter.low)), below
    if above > _ROUND_OFF:
        end = min(high, parameter.high + 1e6 * width)
        yield float(bisect(prior.cdf, 1.0 - 0.5 * above, parameter.high, end)), above


def _answers(forward: ForwardMap, k: int, value: float) -> bool:
    """Return whether the map is valid at the centre with parameter ``k`` at ``value``."""
    theta = forward.scene.centre.at[k].set(value)
    return bool(forward.evaluate(theta).valid)


def standardised(prior: dist.Distribution) -> dist.Distribution:
    """Return ``prior`` itself where it is of an interval about whose middle it lies.

    Else :class:`Standardised`.
    """
    around = Standardised(prior)
    bounded = bool(np.isfinite(bounds(prior)).all())
    return prior if bounded and abs(around.centre) < _CENTRED else around


class Standardised(dist.Distribution):
    """A prior whose unconstrained coordinate has centre 0 and width 1; its density is unchanged.

    Samplers start within a few units of 0. For a normal prior around 75 kPa that would be where no
    forward map answers, and NumPyro gives up; for a log-normal with a median of 2 cut at 700, at
    350, where a law with an exponent b makes stresses of 1e80.
    """

    arg_constraints: dict = {}  # noqa: RUF012
    pytree_data_fields = ("prior", "_support")
    pytree_aux_fields = ("centre",)

    def __init__(self, prior: dist.Distribution) -> None:
        self.prior = prior
        with jax.ensure_compile_time_eval():
            draws = prior.sample(jax.random.key(0), (_DRAWS,))
            unconstrained = np.asarray(biject_to(prior.support).inv(draws))
        self.centre = float(np.median(unconstrained))
        self._support = _StandardisedSupport(prior.support, self.centre, float(unconstrained.std()))
        super().__init__(batch_shape=(), event_shape=())

    def log_prob(self, value: ArrayLike) -> jax.Array:
        """Return the log density of the prior."""
        return self.prior.log_prob(value)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Return draws from the prior."""
        return self.prior.sample(key, sample_shape)


class _StandardisedSupport(constraints.Constraint):
    """The constraint ``base``, whose unconstrained coordinate is shifted and scaled."""

    def __init__(self, base: constraints.Constraint, centre: float, width: float) -> None:
        self.base, self.centre, self.width = base, centre, width

    def __call__(self, x: ArrayLike) -> ArrayLike:
        return self.base(x)

    def feasible_like(self, prototype: ArrayLike) -> ArrayLike:
        return self.base.feasible_like(prototype)

    def tree_flatten(self):  # noqa: ANN202
        return (self.centre, self.width), (("centre", "width"), {"base": self.base})


@biject_to.register(_StandardisedSupport)
def _standardised_transform(constraint: _StandardisedSupport) -> ComposeTransform:
    return ComposeTransform(
        [AffineTransform(constraint.centre, constraint.width), biject_to(constraint.base)]
    )
