"""The DataTree of a posterior: draws, statistics, data and predictions, with labels and units.

Groups have ArviZ's names, so that ArviZ works on the saved file as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import xarray as xr

from calibrate.arviz import base
from calibrate.measurements import Observations
from calibrate.posterior import predictions
from calibrate.state_names import split
from calibrate.statistical_model import Data, Model

_OF_DATA = ("log_likelihood", "posterior_predictive", "prior_predictive")


def make_tree(
    model: Model,
    data: Data,
    draws: Mapping[str, np.ndarray],
    statistics: Mapping[str, np.ndarray],
    rng_key: jax.Array | None,
    means: Mapping[str, np.ndarray] | None = None,
) -> xr.DataTree:
    """Return draws and statistics (chains, draws) by name, with all that follows from them.

    Parameters
    ----------
    means : data without noise at the draws, (chains, draws, *shape) by the observation's name,
        for draws of FEM's posterior; by default the model's forward map gives them.
    rng_key : the random key of replicated data; ``None`` leaves out the predictions
        (``log_likelihood``, ``posterior_predictive``, ``prior``, ``prior_predictive``).
    """
    constants, dims, coords = labels_of(model.observe)
    # ArviZ wants a dimension of every observation: a single number gets one of length 1.
    single = [name for name, values in data.items() if np.ndim(values) == 0]
    dims |= {name: [f"{name}_number"] for name in single}
    groups: dict[str, Any] = {
        "posterior": dict(draws),
        "sample_stats": dict(statistics),
        "observed_data": {name: np.atleast_1d(values) for name, values in data.items()},
        **({"constant_data": constants} if constants else {}),
    }
    rows = np.arange(0)
    if rng_key is not None:
        rows, more = _predictions(model, data, draws, rng_key, means)
        for group in _OF_DATA:
            more[group] |= {name: more[group][name][..., None] for name in single}
        groups.update(more)
    likelihood = groups.pop("log_likelihood", None)
    tree = base.from_dict(groups, dims=dims, coords=coords)
    if likelihood is not None:
        tree["log_likelihood"] = xr.DataTree(_likelihood(likelihood, data, dims, coords))
        replicated = tree["posterior_predictive"].to_dataset()
        tree["posterior_predictive"] = xr.DataTree(replicated.assign_coords(draw=rows))
    _write_units(tree, model)
    return tree


def _predictions(
    model: Model,
    data: Data,
    draws: Mapping[str, np.ndarray],
    rng_key: jax.Array,
    means: Mapping[str, np.ndarray] | None,
) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the groups of predictions, and the draws of each chain that have replicated data."""
    posterior_key, prior_key = jax.random.split(rng_key)
    rows, some = predictions.spread(draws)
    own_means = (
        None if means is None else {name: np.asarray(m)[:, rows] for name, m in means.items()}
    )
    prior = predictions.prior_replicates(model, prior_key)
    groups = {
        "log_likelihood": predictions.log_likelihood(model, draws, data, means),
        "posterior_predictive": predictions.replicates(model, some, posterior_key, own_means),
        "prior": {name: values[None] for name, values in prior.draws.items()},
        "prior_predictive": {name: values[None] for name, values in prior.data.items()},
    }
    return rows, groups


def _likelihood(
    values: Mapping[str, np.ndarray],
    data: Data,
    dims: Mapping[str, list[str]],
    coords: Mapping[str, Any],
) -> xr.Dataset:
    """Return the log likelihoods; dependent data have one number a draw and no data dimensions."""
    full = {name: np.atleast_1d(values).ndim + 2 for name, values in data.items()}
    pointwise: dict[Any, Any] = {
        name: dims[name] for name in values if name in dims and values[name].ndim == full[name]
    }
    used = {name for names in pointwise.values() for name in names}
    return base.dict_to_dataset(
        dict(values), dims=pointwise, coords={n: c for n, c in coords.items() if n in used}
    )


def labels_of(
    observe: Observations,
) -> tuple[dict[str, np.ndarray], dict[str, list[str]], dict[str, Any]]:
    """Return constants, dimensions and coordinates of all observations."""
    constants: dict[str, np.ndarray] = {}
    dims: dict[str, list[str]] = {}
    coords: dict[str, Any] = {}
    for name, part in observe.parts.items():
        more = part.labels(name)
        constants, dims, coords = constants | more[0], dims | more[1], coords | more[2]
    return constants, dims, coords


def units_of(model: Model) -> dict[str, str]:
    """Return units by the names of parameters, observations and unknown numbers of noise."""
    parameters = {p.name: p.unit for p in model.forward.scene.parameters}
    units = {name: parameters[split(name)[0]] for name in model.states.unknowns}
    for name, part in model.observe.parts.items():
        units[name] = part.unit
        # The unknown numbers of every noise are standard deviations and the like.
        units |= dict.fromkeys(model.noise_sites[name].values(), part.unit)
    return units


_WITH_UNITS = ("posterior", "prior", "posterior_predictive", "prior_predictive", "observed_data")


def _write_units(tree: xr.DataTree, model: Model) -> None:
    for group in _WITH_UNITS:
        for name, unit in units_of(model).items():
            if group in tree and name in tree[group].data_vars:
                tree[group][name].attrs["units"] = unit or "1"
    if "constant_data" in tree:  # reference positions
        for constant in tree["constant_data"].data_vars:
            tree["constant_data"][str(constant)].attrs["units"] = "mm"
