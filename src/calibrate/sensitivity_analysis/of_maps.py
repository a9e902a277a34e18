"""Sensitivity of what a forward map predicts, over a prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from calibrate.observations import Observation, Observations, observations
from calibrate.priors import Prior, box_prior
from calibrate.sensitivity_analysis.analysis import Function, analyse
from calibrate.sensitivity_analysis.factors import Factors, check_independent, densities, quantiles
from calibrate.statistical_model.prior_range import fit_to
from emulator.errors import InputError
from emulator.fem.campaign import executor, in_process
from emulator.surrogates.protocol import (
    ForwardMap,
    SolvingMap,
    evaluate_all,
    require_answers,
    solved_by,
)

FIELD = "field"
"""The name under which the whole body's displacement is analysed, node by node."""


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
    """Which parameter moves which observation, and by how much.

    Parameters
    ----------
    forward : over all nodes.
    prior : of independent parameters; uniform over the scene's box, on its scales, by default.
    method, samples : as in :func:`~calibrate.sensitivity_analysis.analyse`.
    groups : parameters varied together, by the group's name.
    field : analyse the size of every node's displacement, too.
    scheduler : address of a Dask scheduler whose workers solve, for a map that is FEM.

    Returns
    -------
    A node for each observation, called like it, and ``field``; each a Dataset of
    :func:`~calibrate.sensitivity_analysis.analyse` whose ``output`` runs over the observation's
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
    found = {}
    with executor(scheduler) as execute:
        solving = forward if scheduler is None else solved_by(forward, execute)
        outputs = _Outputs(solving, parts, field=field)
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
            found[name] = data.assign_attrs(unit=unit)
            if name == FIELD:  # its output is the node of that number
                found[name] = found[name].assign_coords(output=outputs.nodes)
    about = {"forward": forward.label, "scene": scene.name, "method": method, "seed": seed}
    return xr.DataTree.from_dict({"/": xr.Dataset(attrs=about), **found})


def _over_unit_cube(outputs: _Outputs, prior: Prior, factors: Factors) -> tuple[Function, Function]:
    """All numbers (n, m) and their derivatives (n, m, p) at points (n, p) of the unit cube."""

    def at(points: np.ndarray) -> jax.Array:
        return quantiles(prior, factors.names, jnp.asarray(points))

    def values(points: np.ndarray) -> np.ndarray:
        return outputs.values(at(points))

    def slopes(points: np.ndarray) -> np.ndarray:
        thetas = at(points)
        density = np.asarray(densities(prior, factors.names, thetas))
        return outputs.slopes(thetas) / density[:, None, :]

    return _remembered(values), _remembered(slopes)


class _Outputs:
    """All numbers to analyse, one after the other.

    places : of each observation's numbers, and of the field's, by name. nodes : of the map, (k,).
    """

    def __init__(
        self, forward: ForwardMap, parts: Mapping[str, Observation], *, field: bool
    ) -> None:
        nodes = forward.nodes if field else observations(parts).nodes if parts else forward.nodes
        self.nodes, self._map = nodes, forward.at(nodes)
        place = {int(node): k for k, node in enumerate(nodes)}
        self._rows = {
            name: np.array([place[int(node)] for node in part.nodes], dtype=int)
            for name, part in parts.items()
        }
        self._parts, self._field = parts, field
        sizes = {name: int(np.prod(part.shape)) for name, part in parts.items()}
        sizes |= {FIELD: len(nodes)} if field else {}
        ends = np.cumsum([0, *sizes.values()])
        self.places = {
            name: slice(*pair) for name, pair in zip(sizes, pairwise(ends.tolist()), strict=True)
        }

    def of(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Numbers (m,) of the displacement ``u`` (k, 3) mm."""
        found = [jnp.ravel(part(u[self._rows[name]], theta)) for name, part in self._parts.items()]
        if self._field:
            square = jnp.sum(u**2, axis=-1)
            # The derivative of a length is not defined where a node is held.
            moved = square > 0.0
            found.append(jnp.where(moved, jnp.sqrt(jnp.where(moved, square, 1.0)), 0.0))
        return jnp.concatenate(found)

    def values(self, thetas: jax.Array) -> np.ndarray:
        """Numbers (n, m) at ``thetas`` (n, p)."""
        predicted = evaluate_all(self._map, thetas)
        require_answers(self._map, predicted, "sensitivity")
        return np.asarray(jax.jit(jax.vmap(self.of))(predicted.displacement, thetas))

    def slopes(self, thetas: jax.Array) -> np.ndarray:
        """Derivatives (n, m, p) at ``thetas`` (n, p)."""
        if not isinstance(self._map, SolvingMap):
            slope = jax.jacfwd(lambda theta: self.of(self._map(theta), theta))
            return np.asarray(jax.jit(lambda t: jax.lax.map(slope, t))(thetas))
        predicted, moved = self._map.slopes_all(thetas)
        require_answers(self._map, predicted, "sensitivity")
        return np.asarray(jax.jit(jax.vmap(self._along))(predicted.displacement, moved, thetas))

    def _along(self, u: jax.Array, moved: jax.Array, theta: jax.Array) -> jax.Array:
        """Derivatives (m, p) at ``theta`` (p,), from ``u`` (k, 3) and du/dtheta (p, k, 3)."""

        def along(du: jax.Array, direction: jax.Array) -> jax.Array:
            return jax.jvp(self.of, (u, theta), (du, direction))[1]

        return jax.vmap(along, out_axes=-1)(moved, jnp.eye(len(theta)))


def _some(function: Function, entries: slice) -> Function:
    """Some of the outputs (n, m, ...) of ``function``."""
    return lambda points: function(points)[:, entries]


def _remembered(function: Function) -> Function:
    """``function`` that repeats its last answer to the same points."""
    last: dict[bytes, np.ndarray] = {}

    def again(points: np.ndarray) -> np.ndarray:
        key = np.ascontiguousarray(points).tobytes()
        if key not in last:
            last.clear()
            last[key] = function(points)
        return last[key]

    return again
