"""Whether a kept posterior still belongs to the run and the forward map beside it.

``posterior.nc`` carries the run it was sampled for and the fingerprint of its forward map. A
certificate speaks about that run and that map, so any difference is refused.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from calibrate.measurements import Observations
from calibrate.measurements.present import leave_out_missing
from calibrate.posterior import Posterior
from calibrate.statistical_model.approximation_error import ApproximationError
from calibrate.statistical_model.error_modes import ErrorModes
from calibrate.statistical_model.systematic import SystematicError
from emulator.core.errors import InputError
from emulator.core.store import read_arrays, save_arrays
from emulator.surrogates.protocol import ForwardMap

# Paths of scene and emulator may change when a folder moves; their fingerprints may not.
_WORDS = "systematic"  # metadata of a measurement's errors
_PLACES = ("scene", "root", "emulator")


def check_run(path: Path, tree: xr.DataTree, run: Mapping[str, Any]) -> None:
    """:class:`InputError` names the first entry of ``run`` that the posterior was not made with.

    Parameters
    ----------
    path, tree : the posterior's file and its content.
    run : entries of run.json, by name, as they are there.
    """
    try:
        sampled: dict[str, Any] = json.loads(tree.attrs["run"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} does not name the run it was sampled for; infer again") from error
    now = json.loads(json.dumps(run))
    for name in sorted({*sampled, *now} - set(_PLACES)):
        if name not in now:
            raise InputError(
                f"{path} was sampled with {name} = {json.dumps(sampled[name])}, which run.json "
                "lacks; restore it, or infer again"
            )
        if sampled.get(name) != now.get(name):
            raise InputError(
                f"{path} was sampled with {name} = {json.dumps(sampled.get(name))}, but run.json "
                f"says {json.dumps(now.get(name))}; infer again"
            )


def check_forward(path: Path, tree: xr.DataTree, forward: ForwardMap) -> None:
    """:class:`InputError` unless the posterior was made with ``forward``."""
    made_with = tree.attrs.get("forward_fingerprint")
    if made_with != forward.fingerprint:
        raise InputError(
            f"{path} was made with another {forward.kind} map (fingerprint {made_with}; it is "
            f"{forward.fingerprint} now); infer again"
        )


def keep_error(file: Path, error: ErrorModes) -> None:
    """Write what a likelihood allows for besides noise, for :func:`restore_error`."""
    words = {_WORDS: json.dumps(error.words)} if isinstance(error, SystematicError) else {}
    save_arrays(file, error.arrays(), words)


def restore_error(path: Path, tree: xr.DataTree, file: Path) -> ErrorModes:
    """What the likelihood allows for, kept in ``file``, with which the posterior was sampled.

    Raises
    ------
    InputError
        The file is missing, damaged or of another posterior.
    """
    if not file.is_file():
        raise InputError(f"{file}, the error in the likelihood of the posterior, is missing")
    arrays, metadata = read_arrays(file)
    error: ErrorModes
    try:
        if _WORDS in metadata:
            error = SystematicError.restore(arrays, json.loads(metadata[_WORDS]))
        else:
            error = ApproximationError.restore(arrays)
    except KeyError as missing:
        raise InputError(f"{file}: array {missing} is missing; infer again") from missing
    except TypeError as wrong:
        raise InputError(f"{file} holds other arrays than an error has; infer again") from wrong
    if tree.attrs.get("forward_error") != error.fingerprint:
        raise InputError(f"{path} was sampled with another error than {file} holds; infer again")
    return error


def is_of(posterior: Posterior, observe: Observations, data: Mapping[str, np.ndarray]) -> bool:
    """Whether a posterior is of ``data`` of these observations, NaN where missing."""
    reduced, there = leave_out_missing(observe, data)
    described = json.loads(json.dumps(reduced.to_json()))
    return described == json.loads(posterior.tree.attrs["observe"]) and all(
        np.array_equal(np.ravel(there[name]), np.ravel(values))
        for name, values in posterior.data.items()
    )
