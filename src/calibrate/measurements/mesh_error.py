"""What the error of a mesh means for observations."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibrate.measurements import Observations, observations_from_json, parse_observation
from emulator.accuracy.mesh_error import MeshError, MeshErrorEstimate
from emulator.scenes.cavities import ENDOCARDIUM


def on_finer(found: MeshError, observe: Observations) -> Observations:
    """The same observations of the body on the finer mesh.

    Raises
    ------
    InputError
        An observation that is not of a registered kind.
    """
    return observations_from_json(found.finer.scene, observe.to_json())


def errors_of(
    found: MeshError, told: MeshErrorEstimate, observe: str | None = None, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Value and error of each observation, by name.

    Parameters
    ----------
    observe : words as of ``calibrate infer``; by default 24 landmarks, and the volume of a cavity
        that is called so.

    Returns
    -------
    By name ``unit``, ``value`` and ``error``: of one number as they are, of several the root mean
    square; ``relative`` is error over value.
    """
    scene = found.simulator.scene
    if observe is None:
        observe = "landmarks:24" + ("+volume" if ENDOCARDIUM in scene.mesh.facet_sets else "")
    here = parse_observation(scene, observe, seed, ("",))
    there = on_finer(found, here)
    theta = told.theta[None]
    values = here(told.coarse[here.nodes][None], theta)
    finer = there(told.fine[there.nodes][None], theta)
    rows = {}
    for name, part in here.parts.items():
        value, error = (np.asarray(v, float) for v in (values[name], values[name] - finer[name]))
        size, wrong = _size(value), _size(error)
        rows[name] = {
            "unit": part.unit,
            "value": size,
            "error": wrong,
            "relative": abs(wrong) / abs(size) if size else float("nan"),
        }
    return rows


def _size(values: np.ndarray) -> float:
    """A number as it is, of several the root mean square."""
    return float(np.sqrt(np.mean(values**2))) if values.ndim else float(values)
