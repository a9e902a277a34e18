"""What an observation is: a function of displacement and theta that knows its data and its words.

Everything the rest of the package needs to know of an observation is asked here. A new one is a
file beside this one and a line in :mod:`calibrate.measurements.registry`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import jax
import numpy as np

from calibrate.noise.protocol import Noise, Sites
from emulator.scenes.scene import Scene


class Field(NamedTuple):
    """One array of a data file.

    variable : its name in netCDF.
    columns : its columns in CSV; an array of one column has shape (rows,), of k columns (rows, k).
    where : whether it says where was measured, not what. What was measured may be missing.
    """

    variable: str
    columns: tuple[str, ...]
    where: bool = False


LENGTH_UNITS: Mapping[str, float] = {"m": 1e3, "cm": 10.0, "µm": 1e-3}
"""Units that lengths in mm may come in by mistake, each in mm."""


class Labels(NamedTuple):
    """How an observation's data is labelled in the DataTree.

    dims : dimensions of each array, by the array's name.
    coords : values of each dimension.
    constants : arrays that go with the data, such as reference positions.
    """

    dims: Mapping[str, list[str]] = {}
    coords: Mapping[str, Any] = {}
    constants: Mapping[str, np.ndarray] = {}


class Observation(Protocol):
    """A function of the displacement of a few nodes, and of theta."""

    @property
    def quantity(self) -> str:
        """What is measured, such as ``displacement``."""
        ...

    @property
    def unit(self) -> str:
        """Unit of the data; ``1`` where it has none."""
        ...

    @property
    def other_units(self) -> Mapping[str, float]:
        """Units the data may be in by mistake, each with the factor that converts it."""
        ...

    @property
    def nodes(self) -> np.ndarray:
        """Nodes a forward map must return, (k,)."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the data: (d, 3) for displacements of d points, () for one number."""
        ...

    @property
    def default_noise(self) -> Noise:
        """Noise assumed where none is given."""
        ...

    @property
    def sites(self) -> Sites | None:
        """Where each number of the data was measured; ``None`` for what has no one place."""
        ...

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Data without noise (..., *shape), from one load state.

        Parameters
        ----------
        displacement : (..., k, 3) mm, of ``nodes``.
        theta : (..., p), in the order of the scene's ``parameter_names``.
        """
        ...

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` on data of a wrong shape or with values that cannot be.

        NaN marks a missing value and passes.
        """
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Names it may have in a data file; the first is its name where it is observed alone."""
        ...

    def labels(self, name: str) -> Labels:
        """Labels of its data where it is called ``name``."""
        ...

    def to_json(self) -> dict[str, Any]:
        """Plain JSON from which :meth:`Kind.from_json` makes it again; ``kind`` is its kind."""
        ...

    def to_arrays(self, name: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """The arrays of its kind's layout, by variable."""
        ...


class Kind(Observation, Protocol):
    """A kind of observation: what its registry needs to make one from words, JSON and files.

    Attributes
    ----------
    kind : its name in the registry, in JSON and on the command line.
    usage : the words that ask for it on the command line, for help and errors.
    """

    kind: ClassVar[str]
    usage: ClassVar[str]

    @classmethod
    def from_json(cls, scene: Scene, description: Mapping[str, Any]) -> Self:
        """The observation that :meth:`to_json` described."""
        ...

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """Name and observation that ``word`` of the command line asks for.

        ``None`` where the word is not one of this kind; ``seed`` is for random selections.
        """
        ...

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, tuple[Field, ...]]:
        """Arrays that would hold an observation of this kind, by the observation's name.

        ``words`` are the columns or variables of a file, of which some may be missing, or the
        observation's name with the variables of :meth:`to_arrays`.
        """
        ...

    @classmethod
    def from_arrays(
        cls, scene: Scene, name: str, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Observation and data from the arrays of its layout; inverse of :meth:`to_arrays`."""
        ...
