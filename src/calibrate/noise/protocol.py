"""What measurement noise is: the density of data given its mean, with what of it is unknown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Self

import jax
import numpy as np
import numpyro.distributions as dist


class Noise(Protocol):
    """Noise of one observation, in the observation's unit.

    Attributes
    ----------
    kind : its name in the registry and in JSON.
    """

    kind: ClassVar[str]

    @property
    def priors(self) -> Mapping[str, dist.Distribution]:
        """Priors of its unknown numbers, by their names, e.g. ``noise_sd``; empty if all known."""
        ...

    @property
    def upper_sd(self) -> float:
        """Standard deviation, or the largest that its prior makes plausible."""
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
