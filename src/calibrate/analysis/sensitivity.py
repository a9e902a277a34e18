"""Sensitivity of what a forward map predicts, over a prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from calibrate.analysis.indices import (
    Factors,
    Function,
    analyse,
    check_independent,
    densities,
    quantiles,
)
from calibrate.measurements import Observation, Observations, observations
from calibrate.measurements.outputs import FIELD, Outputs
from calibrate.priors import Prior, box_prior
from calibrate.statistical_model.prior_range import fit_to
from emulator.core.errors import InputError
from emulator.fem.campaign import executor, in_process
from emulator.surrogates.protocol import ForwardMap, solved_by


def sensitivity(
    forward: ForwardMap,
    observe: Observation | Observations | None = None,
    *,
    prior: Prior | None = None,
    method: str = "sobol",
    samples: int = 512,
    groups: Mapping[str, Sequence[str]] | None = None,
    field: bool = False,
    seed: int = 0,
    scheduler: str | None = None,
) -> xr.DataTree:
    """Return how much each parameter moves each observation.

    Parameters
    ----------
    forward : the forward map over all nodes.
    prior : the prior of independent parameters; by default uniform over the scene's box, on its
        scales.
    method, samples : the arguments of :func:`~calibrate.analysis.indices.analyse`.
    groups : the parameters that vary together, by the group's name.
    field : whether the size of every node's displacement is analysed, too.
    scheduler : the address of a Dask scheduler whose workers solve, for a map that is FEM.

    Returns
    -------
    A node for each observation, called like it, and ``field``; each a Dataset of
    :func:`~calibrate.analysis.indices.analyse` whose ``output`` runs over the observation's
    numbers, or over the mesh's nodes, and whose attributes have the unit.

    Raises
    ------
    InputError
        Nothing to analyse; several load states; correlated parameters; a prior that leaves the
        range in which the map answers; a scheduler that does not answer, or beside a map that
        solves no FEM.
    """
    scene = forward.scene
    if observe is None and not field:
        raise InputError("sensitivity: give something to observe, or ask for the field")
    parts = {} if observe is None else dict(observations(observe).parts)
    if observe is not None and observations(observe).states != ("",):
        raise InputError("sensitivity: observations of several load states; take one at a time")
    if scheduler is not None:
        solved_by(forward, in_process)  # a map that solves nothing is refused before connecting
    prior = box_prior(scene) if prior is None else prior
    check_independent(prior)
    prior, _ = fit_to(forward, prior)
    factors = Factors(scene.parameter_names, dict(groups or {}))
    datasets = {}
    with executor(scheduler) as execute:
        solving = forward if scheduler is None else solved_by(forward, execute)
        outputs = Outputs(solving, parts, field=field, what="sensitivity")
        function, derivative = _over_unit_cube(outputs, prior, factors)
        for name, entries in outputs.places.items():
            data = analyse(
                factors,
                _some(function, entries),
                method=method,
                samples=samples,
                derivative=_some(derivative, entries),
                seed=seed,
            )
            unit = "mm" if name == FIELD else parts[name].unit
            datasets[name] = data.assign_attrs(unit=unit)
            if name == FIELD:  # its output is the node of that number
                datasets[name] = datasets[name].assign_coords(output=outputs.nodes)
    about = {"forward": forward.label, "scene": scene.name, "method": method, "seed": seed}
    return xr.DataTree.from_dict({"/": xr.Dataset(attrs=about), **datasets})


def _over_unit_cube(outputs: Outputs, prior: Prior, factors: Factors) -> tuple[Function, Function]:
    """Return functions of points (n, p) of the unit cube: all numbers (n, m), and derivatives."""

    def at(points: np.ndarray) -> jax.Array:
        return quantiles(prior, factors.names, jnp.asarray(points))

    def values(points: np.ndarray) -> np.ndarray:
        return outputs.values(at(points))

    def slopes(points: np.ndarray) -> np.ndarray:
        thetas = at(points)
        density = np.asarray(densities(prior, factors.names, thetas))
        return outputs.slopes(thetas) / density[:, None, :]

    return _remembered(values), _remembered(slopes)


def _some(function: Function, entries: slice) -> Function:
    """Return a function that gives some of the outputs (n, m, ...) of ``function``."""
    return lambda points: function(points)[:, entries]


def _remembered(function: Function) -> Function:
    """Return ``function``, made to repeat its last answer to the same points."""
    last: dict[bytes, np.ndarray] = {}

    def again(points: np.ndarray) -> np.ndarray:
        key = np.ascontiguousarray(points).tobytes()
        if key not in last:
            last.clear()
            last[key] = function(points)
        return last[key]

    return again
