"""Numbers that a forward map predicts for observations: derivatives in theta, error of the mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.collection import Observations, observations
from calibrate.measurements.observation import Observation
from calibrate.measurements.registry import observations_from_json, parse_observation
from emulator.accuracy.mesh_error import MeshError, MeshErrorEstimate
from emulator.scenes.scene import ENDOCARDIUM
from emulator.surrogates.protocol import (
    ForwardMap,
    Prediction,
    SolvingMap,
    evaluator,
    require_answers,
)

FIELD = "field"
"""The name of the displacement's length at every node."""


class Outputs:
    """All numbers that are observed of a forward map, one after the other.

    Programs are compiled once.

    Parameters
    ----------
    forward : the forward map.
    parts : the observations, by name.
    field : whether to observe every node's displacement, too.
    what : the beginning of the line of a refusal.

    Attributes
    ----------
    places : the slice of each observation's numbers, and of the field's, by name.
    nodes : the nodes that the map predicts, (k,).
    """

    def __init__(
        self,
        forward: ForwardMap,
        parts: Mapping[str, Observation],
        *,
        field: bool = False,
        what: str = "prediction",
    ) -> None:
        nodes = forward.nodes if field else observations(parts).nodes if parts else forward.nodes
        self.nodes, self._map = nodes, forward.at(nodes)
        position = {int(node): k for k, node in enumerate(nodes)}
        self._rows = {
            name: np.array([position[int(node)] for node in part.nodes], dtype=int)
            for name, part in parts.items()
        }
        self._parts, self._field, self._what = parts, field, what
        sizes = {name: int(np.prod(part.shape)) for name, part in parts.items()}
        sizes |= {FIELD: len(nodes)} if field else {}
        ends = np.cumsum([0, *sizes.values()])
        self.places = {
            name: slice(*pair) for name, pair in zip(sizes, pairwise(ends.tolist()), strict=True)
        }

    def of(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the numbers (m,) for the displacement ``u`` (k, 3) mm at ``theta`` (p,)."""
        numbers = [
            jnp.ravel(part(u[self._rows[name]], theta)) for name, part in self._parts.items()
        ]
        if self._field:
            square = jnp.sum(u**2, axis=-1)
            # The derivative of a length is not defined where the displacement is 0.
            nonzero = square > 0.0
            numbers.append(jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, square, 1.0)), 0.0))
        return jnp.concatenate(numbers)

    def values(self, thetas: jax.Array) -> np.ndarray:
        """Return the numbers (n, m) at ``thetas`` (n, p).

        Raises
        ------
        InputError
            The map has no answer at one of them.
        """
        predicted = self._predict(thetas)
        require_answers(self._map, predicted, self._what)
        return np.asarray(self._values(predicted.displacement, thetas))

    def slopes(self, thetas: jax.Array) -> np.ndarray:
        """Return derivatives (n, m, p) at ``thetas`` (n, p).

        Raises
        ------
        InputError
            The map has no answer at one of them.
        """
        if not isinstance(self._map, SolvingMap):
            require_answers(self._map, self._predict(thetas), self._what)
            return np.asarray(self._derivatives(thetas))
        predicted, sensitivities = self._map.slopes_all(thetas)
        require_answers(self._map, predicted, self._what)
        return np.asarray(self._derivatives_along(predicted.displacement, sensitivities, thetas))

    def _along(self, u: jax.Array, sensitivity: jax.Array, theta: jax.Array) -> jax.Array:
        """Return derivatives (m, p) at ``theta`` (p,), by ``u`` (k, 3) and du/dtheta (p, k, 3)."""

        def along(du: jax.Array, direction: jax.Array) -> jax.Array:
            return jax.jvp(self.of, (u, theta), (du, direction))[1]

        return jax.vmap(along, out_axes=-1)(sensitivity, jnp.eye(len(theta)))

    @cached_property
    def _predict(self) -> Callable[[jax.Array], Prediction]:
        return evaluator(self._map)

    @cached_property
    def _values(self) -> Callable[[jax.Array, jax.Array], jax.Array]:
        return jax.jit(jax.vmap(self.of))

    @cached_property
    def _derivatives(self) -> Callable[[jax.Array], jax.Array]:
        slope = jax.jacfwd(lambda theta: self.of(self._map(theta), theta))
        return jax.jit(lambda thetas: jax.lax.map(slope, thetas))

    @cached_property
    def _derivatives_along(self) -> Callable[..., jax.Array]:
        return jax.jit(jax.vmap(self._along))


def on_finer(error: MeshError, observe: Observations) -> Observations:
    """Return the same observations of the body on the finer mesh.

    Raises
    ------
    InputError
        An observation that is not of a registered kind.
    """
    return observations_from_json(error.finer.scene, observe.to_json())


def mesh_errors(
    error: MeshError, estimate: MeshErrorEstimate, observe: str | None = None, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Return the value and the mesh's error of each observation, by name.

    Parameters
    ----------
    error : the simulators on both meshes.
    estimate : the displacements on both meshes at one theta.
    observe : words as of ``calibrate infer``; by default 24 landmarks, and the volume of a cavity
        whose wall is called ``endocardium``.
    seed : the seed for places drawn at random.

    Returns
    -------
    By name ``unit``, ``value`` and ``error``: of one number as they are, of several the root mean
    square; ``relative`` is error over value.
    """
    scene = error.simulator.scene
    if observe is None:
        observe = "landmarks:24" + ("+volume" if ENDOCARDIUM in scene.mesh.facet_sets else "")
    coarse = parse_observation(scene, observe, seed, ("",))
    fine = on_finer(error, coarse)
    theta = estimate.theta[None]
    values = coarse(estimate.coarse[coarse.nodes][None], theta)
    finer = fine(estimate.fine[fine.nodes][None], theta)
    rows = {}
    for name, part in coarse.parts.items():
        size, difference = _size(values[name]), _size(values[name] - finer[name])
        rows[name] = {
            "unit": part.unit,
            "value": size,
            "error": difference,
            "relative": abs(difference) / abs(size) if size else float("nan"),
        }
    return rows


def _size(values: jax.Array) -> float:
    """Return a number as it is, or the root mean square of several."""
    array = np.asarray(values, float)
    return float(np.sqrt(np.mean(array**2))) if array.ndim else float(array)
