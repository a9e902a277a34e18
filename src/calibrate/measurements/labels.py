"""Labels of data in the DataTree: constants, dimensions and coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibrate.measurements.collection import Observations
from calibrate.measurements.points import DISPLACEMENT, XYZ, PointObservation


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
