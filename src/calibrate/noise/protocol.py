"""What measurement noise is: the density of data given its mean, with what of it is unknown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import jax
import numpy as np
import numpyro.distributions as dist


class Sites(NamedTuple):
    """Where each number of an observation's data was measured, the data's axes raveled.

    positions : (e, 3) mm in the reference body.
    component : (e,) which component of a vector or tensor it is; components do not correlate.
    """

    positions: np.ndarray
    component: np.ndarray

    @classmethod
    def of(cls, positions: np.ndarray, components: int) -> Sites:
        """Sites of data (d, components) measured at ``positions`` (d, 3)."""
        count = len(positions)
        return cls(np.repeat(positions, components, axis=0), np.tile(np.arange(components), count))


class Noise(Protocol):
    """Noise of one observation, in the observation's unit.

    Attributes
    ----------
    kind : its name in the registry and in JSON.
    gaussian : whether it is Gaussian where all its numbers are known.
    usage : its options on the command line, for help and errors.
    """

    kind: ClassVar[str]
    gaussian: ClassVar[bool]
    usage: ClassVar[str]

    def at(self, sites: Sites | None) -> Self:
        """The noise of data measured at ``sites``.

        Raises
        ------
        InputError
            Noise that correlates in space, for data that has no one place.
        """
        ...

    def inferred(self, scale: float) -> Self:
        """The noise with its sd unknown, under a half-normal prior of this scale."""
        ...

    @property
    def priors(self) -> Mapping[str, dist.Distribution]:
        """Priors of its unknown numbers, by their names, e.g. ``noise_sd``; empty if all known."""
        ...

    @property
    def upper_sd(self) -> float:
        """Largest standard deviation of any combination of the data whose weights have norm 1.

        The sd itself for independent noise. Where it is unknown, the largest that its prior makes
        plausible.
        """
        ...

    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Distribution of data with mean ``mean``; ``values`` of the unknown numbers by name.

        All axes of ``mean`` are event axes, so that the log density is one number.
        """
        ...

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Noise of data of this shape; :class:`InputError` where a number of it is unknown."""
        ...

    def to_json(self) -> dict[str, Any]:
        """Plain JSON from which :meth:`from_json` makes it again; ``kind`` is its kind."""
        ...

    @classmethod
    def from_json(cls, description: Mapping[str, Any]) -> Self:
        """The noise that :meth:`to_json` described."""
        ...
