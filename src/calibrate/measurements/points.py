"""Observations at places of the body: what their words, columns and labels have in common.

The data of such an observation has one row for each place, and columns for the components of what
was measured there.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, ClassVar, Self

import numpy as np

from calibrate.measurements.observation import (
    LENGTH_UNITS,
    Block,
    Field,
    Labels,
    Observation,
    Table,
)
from calibrate.noise.protocol import Sites
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene

XYZ = ("x", "y", "z")
DISPLACEMENT = "displacement"


class PointObservation(Observation):
    """Numbers (d, c) of c components at d places, or (d,) where ``components`` is empty.

    A kind declares, in addition to what an :class:`Observation` does,

    name : its name in data files; ``{}`` stands for a facet set.
    arguments : the names of the arguments of ``of`` after the scene, which are attributes of the
        observation and keys of its JSON, too. The last are the places.
    place_field : the field of the places in a file. The names of fields may have ``{}``, too.
    value_fields : the fields of what was measured.
    components : names of the components, or none.
    points : positions of the places in the reference body, mm, (d, 3).
    """

    name: ClassVar[str]
    arguments: ClassVar[tuple[str, ...]]
    place_field: ClassVar[Field]
    value_fields: ClassVar[tuple[Field, ...]]
    components: tuple[str, ...]
    points: np.ndarray

    @classmethod
    def spread(cls, scene: Scene, selection: str, count: int, seed: int) -> np.ndarray:
        """Return ``count`` places drawn at random, for words ``kind:selection:count``."""
        raise NotImplementedError

    @classmethod
    def fields(cls, *selection: Any) -> tuple[Field, ...]:
        """Return the fields of an observation with this selection: all arguments but the places."""
        return tuple(field.named(*selection) for field in (cls.place_field, *cls.value_fields))

    @classmethod
    def selections(cls, words: Collection[str]) -> list[tuple[Any, ...]]:
        """Return the selections that the columns or variables ``words`` of a file name."""
        return [()]

    @classmethod
    def located(
        cls, scene: Scene, selection: tuple[Any, ...], places: np.ndarray, values: np.ndarray
    ) -> Self:
        """Return the observation at the places of a file; ``values`` (d, c) are for errors."""
        return cls.of(scene, *selection, places)

    @property
    def selection(self) -> tuple[Any, ...]:
        """All arguments but the places."""
        return tuple(getattr(self, argument) for argument in self.arguments[:-1])

    @property
    def names(self) -> tuple[str, ...]:
        """The declared name, of the facet set where there is one."""
        return (self.name.format(*self.selection),)

    @property
    def full_shape(self) -> tuple[int, ...]:
        """(d, c), or (d,) without components."""
        count = len(getattr(self, self.arguments[-1]))
        return (count, len(self.components)) if self.components else (count,)

    @property
    def full_sites(self) -> Sites:
        """The points, for each component."""
        return Sites.of(self.points, max(len(self.components), 1))

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """Read ``kind:N`` or ``kind:selection:N``: N places drawn at random."""
        kind, _, rest = word.partition(":")
        if kind != cls.kind:
            return None
        selects = len(cls.arguments) > 1
        before, _, number = rest.rpartition(":") if selects else ("", "", rest)
        if not rest or (selects and not before):
            raise cls.misuse(word)
        if not (number.isascii() and number.isdigit()) or int(number) < 1:
            raise InputError(f"observe '{word}': '{number}' is not a number of {kind}")
        places = cls.spread(scene, before, int(number), seed)
        part = cls.of(scene, *((before,) if selects else ()), places)
        return part.names[0], part

    def described(self) -> dict[str, Any]:
        """Return the arguments of ``of``."""
        arguments = {argument: getattr(self, argument) for argument in self.arguments}
        return {
            a: v if isinstance(v, str) else np.asarray(v).tolist() for a, v in arguments.items()
        }

    @classmethod
    def from_json(cls, scene: Scene, description: Mapping[str, Any]) -> Self:
        """Return the observation with these arguments."""
        *selection, places = (description[argument] for argument in cls.arguments)
        return cls.of(scene, *selection, np.asarray(places))

    @classmethod
    def tables(cls, words: Collection[str]) -> dict[str, Table]:
        """Return one table for each selection."""
        every = cls.selections(words)
        return {cls.name.format(*s): Table(s, cls.fields(*s)) for s in every}

    @classmethod
    def read(
        cls, scene: Scene, name: str, table: Table, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Return the observation and its data, from places and values."""
        place, *fields = table.fields
        places = arrays[place.variable]
        values = np.column_stack([arrays[field.variable] for field in fields])
        check_table(places, values, cls.quantity, sum(len(field.columns) for field in fields))
        part = cls.located(scene, table.arguments, places, values)
        return part, values if part.components else values[:, 0]

    def block(self, name: str, values: np.ndarray) -> Block:
        """Return the places, and the values of each field."""
        place, *fields = self.fields(*self.selection)
        rows = values.reshape(len(values), -1)
        ends = np.cumsum([len(field.columns) for field in fields])
        columns = np.split(rows, ends[:-1], axis=1)
        arrays = [each[:, 0] if each.shape[1] == 1 else each for each in columns]
        places = getattr(self, self.arguments[-1])
        return [(place, places), *zip(fields, arrays, strict=True)]

    def constants(self) -> dict[str, np.ndarray]:
        """Return vectors (d, 3) at the places that go with the data in the DataTree, by name."""
        return {"position": self.points}

    def rows(self) -> tuple[str, np.ndarray]:
        """Return the name of the data's first dimension, and its coordinate (d,)."""
        return "point", np.arange(len(self.points))

    def full_labels(self, name: str) -> Labels:
        """Return places and components; the reference positions are a constant."""
        # Only one observation is called `displacement`; it keeps the plain labels.
        suffix = "" if name == DISPLACEMENT else f"_{name}"
        word, numbers = self.rows()
        row, vector = f"{word}{suffix}", self.components == XYZ
        column, axis = ("component", "component") if vector else (f"component{suffix}", "axis")
        constants = {f"{word}{suffix}": values for word, values in self.constants().items()}
        dims = {name: [row, column] if self.components else [row]}
        coords: dict[str, Any] = {row: numbers}
        if self.components:
            coords[column] = list(self.components)
        if constants:
            coords[axis] = list(XYZ)
        dims |= {constant: [row, axis] for constant in constants}
        return Labels(dims, coords, constants)

    def check_values(self, name: str, values: np.ndarray) -> None:
        """Refuse an infinite value."""
        infinite = np.isinf(values).reshape(len(values), -1).any(axis=1)
        if infinite.any():
            raise InputError(f"data: {name}, row {int(np.argmax(infinite))} has an infinite value")


class DisplacementPoints(PointObservation):
    """Displacements (d, 3) in mm of points at ``points`` (d, 3) in the reference body.

    Unless a kind gives it another name, at most one such observation fits in a file, and it is
    called ``displacement`` there.
    """

    name = DISPLACEMENT
    quantity = DISPLACEMENT
    unit = "mm"
    other_units = LENGTH_UNITS
    usual_sd = 0.2
    components = XYZ
    value_fields = (Field(DISPLACEMENT, ("ux", "uy", "uz")),)


def check_table(places: np.ndarray, values: np.ndarray, what: str, components: int) -> None:
    """Raise :class:`InputError` on a table that cannot be data.

    Parameters
    ----------
    places : the places, (d,) or (d, 3); they must be finite.
    values : the data, (d, components); each value must be finite or, where missing, NaN.
    what : the word for what was measured, for errors.
    components : the number of components that are expected.
    """
    if values.ndim != 2 or not len(values) or values.shape[1] != components:
        raise InputError(f"{what}s have shape {values.shape}; expected (d, {components})")
    if len(places) != len(values):
        raise InputError(f"{len(places)} points have {len(values)} {what}s")
    unknown = ~np.isfinite(places.reshape(len(places), -1))
    for word, bad in (("position", unknown), (what, np.isinf(values))):
        if bad.any():
            row = int(np.argmax(bad.any(axis=1)))
            raise InputError(f"row {row + 1} has a {word} that is not finite; repair it")


def as_points(points: Any, wrong: str) -> np.ndarray:
    """Return ``points`` as an array (d, 3) in mm.

    Raises
    ------
    InputError
        Another shape, which is put into the message ``wrong`` at ``{}``, or numbers that are not
        finite.
    """
    array = np.atleast_2d(np.asarray(points, dtype=float))
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise InputError(wrong.format(array.shape))
    return array


def check_distinct(points: np.ndarray, what: str) -> None:
    """Raise :class:`InputError` where two of ``points`` (d, 3) mm are one: data counted twice."""
    _, first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
    again = np.flatnonzero(first[inverse.ravel()] != np.arange(len(points)))
    if again.size:
        k = int(again[0])
        raise InputError(
            f"{what} {first[inverse.ravel()[k]]} and {k} are both at {points[k].tolist()} mm; give "
            "each place once, repeated measurements as their mean, with less noise"
        )


def gather(elements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (k,) of ``elements`` (d, a), each once, and positions (d, a) in them."""
    nodes, positions = np.unique(elements, return_inverse=True)
    return nodes, positions.reshape(elements.shape)
