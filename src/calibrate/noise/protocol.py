"""Measurement noise: the density of data given their mean, and which of its numbers are unknown."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.scipy.linalg import block_diag

from emulator.core import schema
from emulator.core.errors import InputError

PLAUSIBLE = 3.0  # scales of a half-normal prior that contain 99.7 % of its mass


class Sites(NamedTuple):
    """The position and component of each number of an observation's raveled data.

    positions : the positions in the reference body, (e, 3) mm.
    component : the index of each number's component of a vector or tensor, (e,); components do not
        correlate with one another.
    """

    positions: np.ndarray
    component: np.ndarray

    @classmethod
    def of(cls, positions: np.ndarray, components: int) -> Sites:
        """Return the sites of data (d, components) measured at ``positions`` (d, 3)."""
        count = len(positions)
        return cls(np.repeat(positions, components, axis=0), np.tile(np.arange(components), count))


@jax.tree_util.register_static
@dataclass(frozen=True)
class Scale:
    """A standard deviation or another scale: known, or inferred under a half-normal prior.

    name : the name of an inferred scale in the posterior.
    options : the names of the two options that set the scale, for error messages.
    known : the value in the observation's unit; or
    prior_scale : the scale of the half-normal prior.

    :class:`InputError` where both are given, neither, or one that is not above 0.
    """

    name: str
    options: tuple[str, str]
    known: float | None
    prior_scale: float | None

    def __post_init__(self) -> None:
        if (self.known is None) == (self.prior_scale is None):
            first, second = self.options
            raise InputError(f"give either {first} (known) or {second} (of its prior)")
        value = self.prior_scale if self.known is None else self.known
        check_positive("standard deviation", value)

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """The half-normal prior by the scale's name; empty for a known scale."""
        return {} if self.prior_scale is None else {self.name: dist.HalfNormal(self.prior_scale)}

    @property
    def upper(self) -> float:
        """The value, or the 99.7 % quantile of the half-normal prior."""
        return self.known or PLAUSIBLE * (self.prior_scale or 0.0)

    def value(self, values: Mapping[str, jax.Array]) -> float | jax.Array:
        """Return its value, from ``values`` by name where it is inferred."""
        return values[self.name] if self.known is None else self.known

    def needed(self) -> float:
        """Return its value, for synthetic data; :class:`InputError` where it is not known."""
        if self.known is None:
            raise InputError("noise: to make data, give its standard deviation")
        return self.known


class Noise(ABC):
    """Noise of one observation, in the observation's unit.

    A kind is a frozen dataclass that derives from this class; its fields are its options. It has

    kind : its name in the registry and in JSON.
    gaussian : whether it is Gaussian where all its numbers are known.
    """

    kind: ClassVar[str]
    gaussian: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self.scales  # noqa: B018 - scales that cannot be are refused here

    @property
    @abstractmethod
    def scales(self) -> tuple[Scale, ...]:
        """The scales of the noise, known or inferred."""

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """Priors of the unknown scales by name, e.g. ``noise_sd``; empty if all are known."""
        return {name: prior for scale in self.scales for name, prior in scale.priors.items()}

    @property
    def upper_sd(self) -> float:
        """Largest plausible standard deviation of data combined with weights of norm 1.

        It is the sd itself for independent Gaussian noise of known sd.
        """
        return self.scales[0].upper

    def size(self, values: Mapping[str, jax.Array]) -> jax.Array:
        """Return the sd of one number of the data; ``values`` are the inferred scales by name."""
        return jnp.sqrt(sum(jnp.square(scale.value(values)) for scale in self.scales))

    def at(self, sites: Sites | None) -> Self:
        """Return the noise of data measured at ``sites``; independent noise is the same everywhere.

        :class:`InputError` where the noise correlates in space, and there are no sites.
        """
        return self

    def inferred(self, scale: float) -> Self:
        """Return the noise with its independent sd unknown, under a half-normal prior of scale."""
        return replace(self, sd=None, sd_scale=scale)  # type: ignore[type-var]

    @abstractmethod
    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Return the distribution of data with mean ``mean``, all of whose axes are event axes.

        ``values`` are the inferred scales by name.
        """

    def information(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> jax.Array:
        """Return the information of data of d numbers about their ``mean``.

        It is the curvature of the log density at the mean: its diagonal (d,) where the numbers are
        independent, (d, d) otherwise. ``values`` are the inferred scales by name.
        """
        of_one = jax.hessian(lambda m: self.distribution(m, values).log_prob(jnp.zeros(())))
        return jnp.full(mean.size, -of_one(jnp.zeros(())))

    @abstractmethod
    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Return noise of data of this shape; :class:`InputError` where a scale is unknown."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON: its kind and its options."""
        return schema.describe(self)


def information_about_means(
    noise: Mapping[str, Noise],
    means: Mapping[str, jax.Array],
    scales: Mapping[str, Mapping[str, jax.Array]] = MappingProxyType({}),
) -> jax.Array:
    """Return the information of all data about their means, in the order of ``ravel_pytree``.

    It is a matrix (d, d), or its diagonal (d,) where all numbers err independently.

    scales : the values of each noise's scales that are not known.
    """
    parts = [noise[n].information(means[n], scales.get(n, {})) for n in sorted(means)]
    if all(part.ndim == 1 for part in parts):
        return jnp.concatenate(parts)
    return block_diag(*(jnp.diag(part) if part.ndim == 1 else part for part in parts))


def check_positive(what: str, value: object) -> None:
    """Raise :class:`InputError` unless ``value`` is a finite number above 0."""
    if not isinstance(value, Real) or not 0.0 < float(value) < float("inf"):
        raise InputError(f"{what} is {value}; it must be above 0")
