"""Observations at points of the body, with their words, columns and labels.

The data of such an observation has one row for each place, and columns for the components of what
was measured there.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, ClassVar, Self

import numpy as np

from calibrate.measurements.observation import Block, DataField, Layout, Observation
from emulator.core.errors import InputError

XYZ = ("x", "y", "z")
DISPLACEMENT = "displacement"


class PointObservation(Observation):
    """Numbers (d, c) of c components at d places, or (d,) where ``components`` is empty.

    A kind declares, in addition to what an :class:`Observation` does,

    name : its name in data files; ``{}`` stands for a facet set.
    place : the name of the last argument of ``of``, which says where; empty where the scene does.
    place_field : the field of the places in a file. The names of fields may have ``{}``, too.
    value_fields : the fields of what was measured.
    spread : the function of the scene, all arguments but the places, a number and a seed that
        draws so many places at random, for words ``kind:argument:number``; None for a kind that
        needs no places in its words.
    constants : attributes (d, 3) that go with the data in the DataTree, by the name there.
    row : the name of the data's first dimension in the DataTree.
    numbers : the attribute (d,) that numbers the rows; they count from 0 where it is empty.

    and has

    components : names of the components, or none.
    points : positions of the places in the reference body, mm, (d, 3).
    """

    name: ClassVar[str]
    place: ClassVar[str] = "points"
    place_field: ClassVar[DataField]
    value_fields: ClassVar[tuple[DataField, ...]]
    spread: ClassVar[Callable[..., np.ndarray] | None] = None
    constants: ClassVar[Mapping[str, str]] = {"position": "points"}
    row: ClassVar[str] = "point"
    numbers: ClassVar[str] = ""
    components: tuple[str, ...]
    points: np.ndarray

    arguments: ClassVar[tuple[str, ...]] = ()
    positive = False

    @property
    def shape(self) -> tuple[int, ...]:
        """(d, c), or (d,) without components."""
        count = len(self.points)
        return (count, len(self.components)) if self.components else (count,)

    @property
    def row_names(self) -> list[str]:
        """The place of each row, in words that follow the name of the number measured there."""
        if self.numbers:
            return [f"in {self.row} {number:g}" for number in getattr(self, self.numbers)]
        return [f"at ({x:.5g}, {y:.5g}, {z:.5g}) mm" for x, y, z in self.points + 0.0]

    @property
    def selection(self) -> tuple[Any, ...]:
        """The arguments of ``of`` without the positions."""
        return tuple(getattr(self, argument) for argument in self.arguments)

    @classmethod
    def values_in(cls, *selection: Any) -> tuple[DataField, ...]:
        """Return the fields of the values of an observation of this selection."""
        return tuple(field.named(*selection) for field in cls.value_fields)

    @property
    def place_block(self) -> Block:
        """The fields of a file that hold the positions, with their arrays."""
        return [(self.place_field.named(*self.selection), getattr(self, self.place))]

    @classmethod
    def layout_of(cls, *selection: Any) -> Layout:
        """Return the layout of an observation of this selection."""
        return Layout(selection, (cls.place_field.named(*selection), *cls.values_in(*selection)))

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, Layout]:
        """Return the layout of the only observation of this kind that fits in a file."""
        return {cls.name: cls.layout_of()}

    @classmethod
    def read(
        cls, scene: Any, layout: Layout, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Return the observation and its data, from the arrays of its layout.

        Places must be finite, and values finite or, where missing, NaN; :class:`InputError` says
        which are not.
        """
        place, *fields = layout.fields
        places = arrays[place.variable]
        if np.ndim(places) != 1 + (len(place.columns) > 1):
            raise InputError(f"'{place.variable}' has shape {np.shape(places)}; give a row a point")
        what, components = cls.quantity, sum(len(field.columns) for field in fields)
        counts = [np.size(arrays[field.variable]) for field in fields]
        if len(set(counts)) > 1:
            raise InputError(f"components of {what}s have {', '.join(map(str, counts))} values")
        values = np.column_stack([arrays[field.variable] for field in fields])
        if values.ndim != 2 or not len(values) or values.shape[1] != components:
            raise InputError(f"{what}s have shape {values.shape}; expected (d, {components})")
        if len(places) != len(values):
            raise InputError(f"{len(places)} points have {len(values)} {what}s")
        unknown = ~np.isfinite(places.reshape(len(places), -1))
        for word, bad in (("position", unknown), (what, np.isinf(values))):
            if bad.any():
                row = int(np.argmax(bad.any(axis=1)))
                raise InputError(f"row {row + 1} has a {word} that is not finite; repair it")
        part = cls.of(scene, *layout.arguments, places)
        return part, values if part.components else values[:, 0]


class DisplacementPoints(PointObservation):
    """Displacements (d, 3) in mm of points at ``points`` (d, 3) in the reference body.

    Unless a kind gives it another name, at most one such observation fits in a file, and it is
    called ``displacement`` there.
    """

    name = DISPLACEMENT
    quantity = DISPLACEMENT
    unit = "mm"
    usual_sd = 0.2
    components = XYZ
    value_fields = (DataField(DISPLACEMENT, ("ux", "uy", "uz")),)


def as_points(points: Any, what: str, *, distinct: bool = True) -> np.ndarray:
    """Return positions ``points`` of observations called ``what`` as an array (d, 3) in mm.

    :class:`InputError` for another shape, numbers that are not finite, or two points at one place,
    which would count data twice.
    """
    array = np.atleast_2d(np.asarray(points, dtype=float))
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise InputError(f"{what} have shape {array.shape}; expected (d, 3), finite, in mm")
    _, first, inverse = np.unique(array, axis=0, return_index=True, return_inverse=True)
    first = first[inverse.ravel()]
    again = np.flatnonzero(first != np.arange(len(array)))
    if distinct and again.size:
        k = int(again[0])
        raise InputError(
            f"{what} {first[k]} and {k} are both at {array[k].tolist()} mm; give "
            "each place once, repeated measurements as their mean, with less noise"
        )
    return array


def gather(elements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (k,) of ``elements`` (d, a), each once, and positions (d, a) in them."""
    nodes, positions = np.unique(elements, return_inverse=True)
    return nodes, positions.reshape(elements.shape)
