"""A standard deviation or another scale that is known, or inferred under a half-normal prior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real

import jax
import numpyro.distributions as dist

from emulator.core.errors import InputError

_PLAUSIBLE = 3.0  # half-normal scales, which hold 99.7 % of its mass


@dataclass(frozen=True)
class Scale:
    """A scale in the observation's unit.

    name : of the unknown, in the posterior.
    options : names of the two options that give it, for errors.
    known : its value; or
    prior_scale : the scale of its half-normal prior.

    Raises
    ------
    InputError
        Both are given, neither, or one that is not above 0.
    """

    name: str
    options: tuple[str, str]
    known: float | None
    prior_scale: float | None

    def __post_init__(self) -> None:
        if (self.known is None) == (self.prior_scale is None):
            first, second = self.options
            raise InputError(f"noise: give either {first} (known) or {second} (of its prior)")
        check_positive("standard deviation", self._given)

    @property
    def _given(self) -> float:
        value = self.prior_scale if self.known is None else self.known
        assert value is not None
        return value

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """Its half-normal prior by its name; empty where it is known."""
        return {} if self.known is not None else {self.name: dist.HalfNormal(self._given)}

    @property
    def upper(self) -> float:
        """Its value, or the 99.7 % quantile of its half-normal prior."""
        return self._given if self.known is not None else _PLAUSIBLE * self._given

    def value(self, values: Mapping[str, jax.Array]) -> float | jax.Array:
        """Its value, if unknown the one in ``values``."""
        return values[self.name] if self.known is None else self.known

    def needed(self) -> float:
        """Its value, for synthetic data; :class:`InputError` where it is not known."""
        if self.known is None:
            raise InputError("noise: to make data, give its standard deviation")
        return self.known


def check_positive(what: str, value: object) -> None:
    """Raise :class:`InputError` unless ``value`` is a finite number above 0."""
    if not isinstance(value, Real) or not 0.0 < float(value) < float("inf"):
        raise InputError(f"noise: {what} is {value}; it must be above 0")
