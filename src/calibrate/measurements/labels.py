"""Names of data in words, and their labels in the DataTree: constants, dimensions, coordinates."""

from __future__ import annotations

from itertools import compress
from typing import Any

import numpy as np

from calibrate.measurements.collection import Observations
from calibrate.measurements.points import DISPLACEMENT, XYZ, PointObservation
from calibrate.state_names import split


def datum_names(observe: Observations, name: str) -> list[str]:
    """Return what, where and in which state each number of an observation's data was measured."""
    part, shape = observe.parts[name], observe.shapes[name]
    if not isinstance(part, PointObservation):
        return (
            [name]
            if shape in ((), (1,))
            else [f"{name}{[*map(int, k)]}" for k in np.ndindex(shape)]
        )
    base, state = split(name)
    of = [c if c.startswith(base) else f"{base} {c}" for c in part.components] or [base]
    state = f" in state {state}" if state else ""
    names = [f"{what} {where}{state}" for where in part.row_names for what in of]
    return [names[k] for k in observe.entries.get(name, range(len(names)))]


def missing_places(observe: Observations) -> dict[str, list[str]]:
    """Return where a value is missing by the observation's name, if one is.

    Components that are missing everywhere, as those out of an image's plane, do not count.
    """
    places = dict[str, list[str]]()
    for name, entries in observe.entries.items():
        part = observe.parts[name]
        if isinstance(part, PointObservation):
            gaps = np.isnan(observe.filled(name, np.zeros(len(entries))))
            gaps = gaps.reshape(len(gaps), -1)
            known = gaps[:, ~gaps.all(axis=0)]
            # The tests of one specimen measure different components, which are not missing.
            lacking = known.any(axis=1) if part.place else known.all(axis=1)
            places[name] = [*compress(part.row_names, lacking)]
    return {name: rows for name, rows in places.items() if rows}


def labels_of(
    observe: Observations,
) -> tuple[dict[str, np.ndarray], dict[str, list[str]], dict[str, Any]]:
    """Return the labels of all observations of places.

    These are the arrays that go with the data, such as reference positions; the dimensions of each
    array, by the array's name; and the values of each dimension. Data with missing values are
    numbered as raveled data without gaps.
    """
    constants: dict[str, np.ndarray] = {}
    dims: dict[str, list[str]] = {}
    coords: dict[str, Any] = {}
    for name, part in observe.parts.items():
        if not isinstance(part, PointObservation):
            continue
        # Only one observation is called `displacement`; it keeps the plain labels.
        suffix = "" if name == DISPLACEMENT else f"_{name}"
        row, vector = f"{part.row}{suffix}", part.components == XYZ
        column, axis = ("component", "component") if vector else (f"component{suffix}", "axis")
        coords[row] = getattr(part, part.numbers) if part.numbers else np.arange(part.shape[0])
        if part.components:
            coords[column] = list(part.components)
        for constant, attribute in part.constants.items():
            constants[f"{constant}{suffix}"] = getattr(part, attribute)
            dims[f"{constant}{suffix}"] = [row, axis]
            coords[axis] = list(XYZ)
        dims[name] = [row, column] if part.components else [row]
        if name in observe.entries:
            dims[name] = [f"entry_{name}"]
            coords[f"entry_{name}"] = observe.entries[name]
    return constants, dims, coords
