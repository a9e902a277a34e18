"""Observations at places of the body: what their words, columns and labels have in common.

The data of such an observation has one row for each place, and columns for the components of what
was measured there.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, ClassVar, Self

import jax
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

XYZ = ("x", "y", "z")
DISPLACEMENT = "displacement"
_ENTRIES = "present"  # key in JSON of the entries that are not missing


class PointObservation(Observation):
    """Numbers (d, c) of c components at d places, or (d,) where ``components`` is empty.

    A kind declares, in addition to what an :class:`Observation` does,

    name : its name in data files; ``{}`` stands for a facet set.
    arguments : as of an :class:`Observation`, and keys of the JSON, too. The last are the places.
    place_field : the field of the places in a file. The names of fields may have ``{}``, too.
    value_fields : the fields of what was measured.
    components : names of the components, or none.
    points : positions of the places in the reference body, mm, (d, 3).
    spread : the function of the scene, all arguments but the places, a number and a seed that
        draws so many places at random, for words ``kind:selection:number``; None for a kind that
        has all its places by itself.
    constants : attributes (d, 3) that go with the data in the DataTree, by the name there.
    """

    name: ClassVar[str]
    place_field: ClassVar[Field]
    value_fields: ClassVar[tuple[Field, ...]]
    spread: ClassVar[Callable[..., np.ndarray] | None] = None
    constants: ClassVar[Mapping[str, str]] = {"position": "points"}
    components: tuple[str, ...]
    points: np.ndarray

    @classmethod
    def fields(cls, *selection: Any) -> tuple[Field, ...]:
        """Return the fields of an observation with this selection: all arguments but the places."""
        return tuple(field.named(*selection) for field in (cls.place_field, *cls.value_fields))

    @classmethod
    def located(
        cls, scene: Any, selection: tuple[Any, ...], places: np.ndarray, values: np.ndarray
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
    def _full_shape(self) -> tuple[int, ...]:
        count = len(getattr(self, self.arguments[-1]))
        return (count, len(self.components)) if self.components else (count,)

    @property
    def shape(self) -> tuple[int, ...]:
        """(d, c), or (d,) without components; (n,) where entries are missing."""
        return self._full_shape if self.entries is None else self.entries.shape

    @property
    def missing(self) -> int:
        """Number of entries left out."""
        return 0 if self.entries is None else int(np.prod(self._full_shape)) - len(self.entries)

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the data without noise (..., *shape), from one load state; see ``evaluate``."""
        values = self.evaluate(displacement, theta)
        if self.entries is None:
            return values
        batch = values.shape[: values.ndim - len(self._full_shape)]
        return values.reshape(*batch, -1)[..., self.entries]

    def filled(self, values: np.ndarray) -> np.ndarray:
        """Return ``values`` (*shape) as data without gaps, NaN where missing."""
        if self.entries is None:
            return np.asarray(values)
        filled = np.full(self._full_shape, np.nan)
        filled.flat[self.entries] = values
        return filled

    @property
    def sites(self) -> Sites:
        """The points, for each component."""
        kept = slice(None) if self.entries is None else self.entries
        return Sites(*(of[kept] for of in Sites.of(self.points, max(len(self.components), 1))))

    @classmethod
    def parse(cls, scene: Any, word: str, seed: int) -> tuple[str, Self]:
        """Read ``kind:N`` or ``kind:selection:N``: N places drawn at random.

        A kind that has all its places by itself is ``kind:selection``.
        """
        kind, _, rest = word.partition(":")
        if cls.spread is None:
            if bool(rest) is not bool(cls.arguments):
                raise cls.misuse(word)
            return cls.name, cls.of(scene, *filter(None, [rest]))
        *selection, number = rest.rsplit(":", 1) if len(cls.arguments) > 1 else [rest]
        if not rest or len(selection) + 1 < len(cls.arguments) or not all(selection):
            raise cls.misuse(word)
        if not (number.isascii() and number.isdigit()) or int(number) < 1:
            raise InputError(f"observe '{word}': '{number}' is not a number of {kind}")
        places = cls.spread(scene, *selection, int(number), seed)
        part = cls.of(scene, *selection, places)
        return part.names[0], part

    def to_json(self) -> dict[str, Any]:
        """Return the arguments of ``of``, and which entries are not missing."""
        arguments = {argument: getattr(self, argument) for argument in self.arguments}
        gaps = {} if self.entries is None else {_ENTRIES: self.entries.tolist()}
        plain = {
            a: v if isinstance(v, str) else np.asarray(v).tolist() for a, v in arguments.items()
        }
        return {"kind": self.kind, **plain, **gaps}

    @classmethod
    def from_json(cls, scene: Any, description: Mapping[str, Any]) -> Self:
        """Return the observation with these arguments and entries."""
        arguments = [description[argument] for argument in cls.arguments]
        places = [np.asarray(each) for each in arguments[-1:]]
        whole = cls.of(scene, *arguments[:-1], *places)
        entries = description.get(_ENTRIES)
        return whole if entries is None else whole.restricted(np.asarray(entries))

    @classmethod
    def tables(cls, words: Collection[str]) -> dict[str, Table]:
        """Return the one table of a kind whose only arguments are the places."""
        return {cls.name: Table((), cls.fields())}

    @classmethod
    def read(
        cls, scene: Any, name: str, table: Table, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Return the observation and its data, from places and values.

        Places must be finite, and values finite or, where missing, NaN; :class:`InputError` says
        which are not.
        """
        place, *fields = table.fields
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
        part = cls.located(scene, table.arguments, places, values)
        return part, values if part.components else values[:, 0]

    def block(self, name: str, values: np.ndarray) -> Block:
        """Return the places, and the values of each field."""
        place, *fields = self.fields(*self.selection)
        ends = np.cumsum([len(field.columns) for field in fields])
        columns = np.split(values.reshape(len(values), -1), ends[:-1], axis=1)
        arrays = [each[:, 0] if each.shape[1] == 1 else each for each in columns]
        places = getattr(self, self.arguments[-1])
        return [(place, places), *zip(fields, arrays, strict=True)]

    def rows(self) -> tuple[str, np.ndarray]:
        """Return the name of the data's first dimension, and its coordinate (d,)."""
        return "point", np.arange(len(self.points))

    def labels(self, name: str) -> Labels:
        """Return places and components; entries with gaps are numbered as in the raveled data."""
        # Only one observation is called `displacement`; it keeps the plain labels.
        suffix = "" if name == DISPLACEMENT else f"_{name}"
        word, numbers = self.rows()
        row, vector = f"{word}{suffix}", self.components == XYZ
        column, axis = ("component", "component") if vector else (f"component{suffix}", "axis")
        constants = {f"{n}{suffix}": getattr(self, a) for n, a in self.constants.items()}
        dims = {constant: [row, axis] for constant in constants}
        coords: dict[str, Any] = {row: numbers}
        if self.components:
            coords[column] = list(self.components)
        if constants:
            coords[axis] = list(XYZ)
        dims[name] = [row, column] if self.components else [row]
        if self.entries is not None:
            dims[name] = [f"entry_{name}"]
            coords[f"entry_{name}"] = self.entries
        return constants, dims, coords

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
