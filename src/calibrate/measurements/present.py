r"""Observations with missing values: the entries that were measured, and no others.

Leaving an entry out is exact. With entries :math:`m` missing and :math:`p` present, the likelihood
of what was measured is

.. math:: p(y_p \mid \theta) = \int p(y_p, y_m \mid \theta)\, dy_m ,

which for independent noise drops the factors of :math:`y_m`, and for correlated Gaussian noise the
rows and columns of its covariance. It supposes that a value is missing for reasons that have
nothing to do with what it would have been.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from calibrate.measurements.protocol import Labels, Observation
from calibrate.measurements.several import Observations
from calibrate.noise.protocol import Noise, Sites
from emulator.core.errors import InputError

ENTRIES = "present"


@dataclass(frozen=True, eq=False)
class Present:
    """Some entries of an observation; the others are missing.

    whole : the observation with all entries.
    entries : (n,) those present, ascending, as positions in the raveled data.
    """

    whole: Observation
    entries: np.ndarray

    @property
    def missing(self) -> int:
        """Number of entries left out."""
        return int(np.prod(self.whole.shape, dtype=int)) - len(self.entries)

    @property
    def quantity(self) -> str:
        """What is measured."""
        return self.whole.quantity

    @property
    def unit(self) -> str:
        """Unit of the data."""
        return self.whole.unit

    @property
    def other_units(self) -> Mapping[str, float]:
        """Units the data may be in by mistake."""
        return self.whole.other_units

    @property
    def nodes(self) -> np.ndarray:
        """Nodes of the whole observation: the forward map stays as it is."""
        return self.whole.nodes

    @property
    def shape(self) -> tuple[int, ...]:
        """(n,)."""
        return self.entries.shape

    @property
    def default_noise(self) -> Noise:
        """Noise assumed where none is given."""
        return self.whole.default_noise

    @property
    def names(self) -> tuple[str, ...]:
        """Names it may have in a data file."""
        return self.whole.names

    @property
    def sites(self) -> Sites | None:
        """Where each entry was measured."""
        sites = self.whole.sites
        return sites and Sites(sites.positions[self.entries], sites.component[self.entries])

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """The entries (..., n) without noise."""
        values = self.whole(displacement, theta)
        batch = values.shape[: values.ndim - len(self.whole.shape)]
        return values.reshape(*batch, -1)[..., self.entries]

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` on values that the whole observation would refuse."""
        if values.shape != self.shape:
            raise InputError(
                f"data has shape {values.shape}; the observation expects {self.shape}, "
                f"as {self.missing} values are missing ({name}, {self.unit})"
            )
        self.whole.check(name, self.filled(values))

    def labels(self, name: str) -> Labels:
        """Entries, numbered as in the raveled data; constants of the whole observation."""
        entry, whole = f"entry_{name}", self.whole.labels(name)
        coords = {**whole.coords, entry: self.entries}
        return Labels({**whole.dims, name: [entry]}, coords, whole.constants)

    def to_json(self) -> dict[str, Any]:
        """The whole observation's JSON, and the entries."""
        return {**self.whole.to_json(), ENTRIES: self.entries.tolist()}

    def to_arrays(self, name: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """The whole observation's arrays, NaN where missing."""
        return self.whole.to_arrays(name, self.filled(np.asarray(values)))

    def filled(self, values: np.ndarray) -> np.ndarray:
        """``values`` (n,) of the entries as data of the whole observation, NaN where missing."""
        filled = np.full(int(np.prod(self.whole.shape, dtype=int)), np.nan)
        filled[self.entries] = values
        return filled.reshape(self.whole.shape)


def leave_out_missing(
    observe: Observations, data: Mapping[str, np.ndarray]
) -> tuple[Observations, dict[str, np.ndarray]]:
    """Observations and data without the entries that are NaN; those without any stay as they are.

    Raises
    ------
    InputError
        An observation of which every value is missing.
    """
    parts, kept = dict(observe.parts), dict(data)
    for name, values in data.items():
        check_some(name, values)
        there = np.flatnonzero(~np.isnan(values))
        if len(there) < np.size(values):
            parts[name], kept[name] = _of(parts[name], there), np.ravel(values)[there]
    return replace(observe, parts=parts), kept


def _of(part: Observation, there: np.ndarray) -> Present:
    if isinstance(part, Present):
        return Present(part.whole, part.entries[there])
    return Present(part, there)


def check_some(name: str, values: np.ndarray) -> None:
    """Raise :class:`InputError` where every one of ``values`` is missing."""
    if np.isnan(values).all():
        raise InputError(f"data: every value of {name} is missing; give one, or leave {name} out")


def missing_values(observe: Observations) -> dict[str, int]:
    """Number of missing values by the observation's name, where there are any."""
    return {name: part.missing for name, part in observe.parts.items() if isinstance(part, Present)}
