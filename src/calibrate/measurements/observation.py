"""Observations: measured numbers as functions of displacement and of theta.

A kind of observation is a declaration: its words, quantity, unit and columns, and the function
``evaluate``. It makes itself from a scene (``of``). Everything else is written once for all kinds:
command-line words and JSON (:mod:`calibrate.measurements.words`), data files
(:mod:`calibrate.measurements.data`), missing values (:mod:`calibrate.measurements.collection`),
labels (:mod:`calibrate.measurements.labels`) and the usual noise
(:mod:`calibrate.measurements.usual_noise`). Numbers at several places declare more
(:mod:`calibrate.measurements.points`). A new kind is a file beside this one and a line in
:data:`calibrate.measurements.OBSERVATIONS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import jax
import numpy as np
from scipy.sparse import csr_array

from emulator.core.errors import InputError
from emulator.surrogates.protocol import ForwardMap


class DataField(NamedTuple):
    """One array of a data file.

    variable : its name in netCDF.
    columns : its columns in CSV; an array of one column has shape (rows,), of k columns (rows, k).
    where : True for a coordinate of the measurement, False for a measured value. Only values may be
        missing.
    """

    variable: str
    columns: tuple[str, ...]
    where: bool = False

    def named(self, *words: object) -> DataField:
        """Return the field with ``words`` in place of ``{}`` in its names."""
        columns = tuple(column.format(*words) for column in self.columns)
        return DataField(self.variable.format(*words), columns, self.where)


class Layout(NamedTuple):
    """The arrays of a data file that hold one observation.

    arguments : the arguments of ``of`` that the columns' names contain, such as a facet set.
    fields : the arrays; coordinates come first.
    """

    arguments: tuple[Any, ...]
    fields: tuple[DataField, ...]


Block = Sequence[tuple[DataField, np.ndarray]]
"""The fields of one observation with their arrays."""


class Observation(ABC):
    """Measured numbers as a function of the displacement of a few nodes, and of theta.

    This class is an observation of one number; its column is called as on the command line,
    ``kind:argument:argument``. A kind is a frozen dataclass that declares

    kind : its name in the registry, in JSON and on the command line.
    hint : the text that help and errors add to the words that ask for it.
    arguments : the names of the arguments of ``of`` that words give, attributes of the observation.
    kind_is_name : whether it may be called as its kind in a data file, without arguments.
    quantity : the measured quantity, such as ``displacement``.
    unit : the unit of the data; ``1`` where it has none.
    usual_sd : the standard deviation of the noise where none is given; None if it must be given.
    positive : whether the data must be above 0.
    nodes : the nodes whose displacement it needs, (k,).
    """

    kind: ClassVar[str]
    hint: ClassVar[str] = ""
    arguments: ClassVar[tuple[str, ...]]
    kind_is_name: ClassVar[bool] = False
    quantity: ClassVar[str]
    usual_sd: ClassVar[float | None] = None
    positive: ClassVar[bool] = True
    unit: str
    nodes: np.ndarray

    @abstractmethod
    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the data without noise, (..., *shape), in one load state.

        displacement : the displacement of ``nodes``, mm, (..., k, 3).
        theta : the parameters in the order of the scene's ``parameter_names``, (..., p).
        """

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the data without noise, see :meth:`evaluate`."""
        return self.evaluate(displacement, theta)

    @classmethod
    def of(cls, scene: Any, *arguments: Any, **options: Any) -> Self:
        """Return the observation of ``scene`` that the arguments describe, as text or arrays."""
        return cls(scene, *arguments)  # type: ignore[call-arg]

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the data."""
        return ()

    @property
    def matrix(self) -> csr_array | None:
        """The matrix (e, 3 k) of the data (e,) by the displacement of the nodes, (3 k,).

        None where the data is no linear function of the displacement, or depends on theta.
        """
        return None

    def through(self, forward: ForwardMap) -> Callable[[jax.Array], jax.Array] | None:
        """Return the data without noise, (*shape), as a function of theta (p,), or None.

        A function is returned where the map predicts this observation better than its displacement
        does, which is only nearly in equilibrium, or with less work.
        """
        return None

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, Layout]:
        """Return the layouts of this kind's observations in a file, by the observation's name.

        ``words`` are the columns or variables of a file; some that a layout needs may be missing.
        """
        names = (word for word in words if word.partition(":")[0] == cls.kind)
        return {name: Layout((), (DataField(name, (name,)),)) for name in names}

    def fault(self, name: str, values: np.ndarray) -> str | None:
        """Return a sentence on ``values`` of data called ``name`` that are impossible, or None.

        values : the data without infinite values, NaN where missing.
        """
        if self.positive and (values <= 0.0).any():
            return f"{name} is {values} {self.unit}; it must be above 0"
        return None


Scalar = Observation
"""The base class of a single number."""


def derive(part: Observation, **attributes: Any) -> None:
    """Set attributes of a frozen observation that follow from its fields, in ``__post_init__``."""
    for name, value in attributes.items():
        object.__setattr__(part, name, value)


def check_values(part: Observation, name: str, values: np.ndarray) -> None:
    """Raise :class:`InputError` if a value of the data is infinite or impossible; NaN passes."""
    infinite = np.isinf(values)
    if infinite.any():
        if not values.shape:
            raise InputError(f"data: {name} is {values}; it must be finite")
        row = int(np.argwhere(infinite)[0, 0]) + 1
        raise InputError(f"data: {name}, row {row} has an infinite value")
    if fault := part.fault(name, values):
        raise InputError(f"data: {fault}")
