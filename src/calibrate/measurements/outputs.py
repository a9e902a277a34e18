"""Numbers that a forward map predicts for observations: derivatives in theta, error of the mesh."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements import (
    Observations,
    observations_from_json,
    parse_observation,
)
from emulator.accuracy.mesh_error import MeshError, MeshErrorEstimate
from emulator.core.errors import InputError
from emulator.scenes.scene import ENDOCARDIUM
from emulator.surrogates.fem import FEMForward
from emulator.surrogates.protocol import ForwardMap, Prediction

FIELD = "field"
"""The name of the displacement's length at every node."""
_AT_ONCE = 64  # theta in one batch


class Outputs:
    """All numbers that are observed of a forward map, one after the other.

    Programs are compiled once.

    forward : the forward map.
    observe : the observations; None for none.
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
        observe: Observations | None,
        *,
        field: bool = False,
        what: str = "prediction",
    ) -> None:
        nodes = forward.nodes if field or observe is None else observe.nodes
        self.nodes, self._map = nodes, forward.at(nodes)
        self._observe, self._field, self._what = observe, field, what
        solves = isinstance(forward, FEMForward)
        self._through = None if observe is None or solves else observe.through(forward)
        position = {int(node): k for k, node in enumerate(nodes)}
        seen = () if observe is None else observe.nodes.tolist()
        self._rows = np.array([position[node] for node in seen], dtype=int)
        shapes = {} if observe is None else observe.shapes
        sizes = {name: int(np.prod(shape)) for name, shape in shapes.items()}
        sizes |= {FIELD: len(nodes)} if field else {}
        ends = np.cumsum([0, *sizes.values()])
        self.places = {
            name: slice(*pair) for name, pair in zip(sizes, pairwise(ends.tolist()), strict=True)
        }

    def of(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the numbers (m,) for the displacement ``u`` (k, 3) mm at ``theta`` (p,)."""
        numbers: list[jax.Array] = []
        if self._observe is not None:
            if self._through is None:
                seen = self._observe(u[None, self._rows], theta[None])
            else:
                seen, _ = self._through(theta[None])
            numbers += [jnp.ravel(values) for values in seen.values()]
        if self._field:
            square = jnp.sum(u**2, axis=-1)
            # The derivative of a length is not defined where the displacement is 0.
            nonzero = square > 0.0
            numbers.append(jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, square, 1.0)), 0.0))
        return jnp.concatenate(numbers)

    def values(self, thetas: jax.Array) -> np.ndarray:
        """Return the numbers (n, m) at ``thetas`` (n, p).

        :class:`InputError` where the map has no answer at one of them.
        """
        predicted = self._answered(self._predict(thetas))
        return np.asarray(self._values(predicted.displacement, thetas))

    def slopes(self, thetas: jax.Array) -> np.ndarray:
        """Return derivatives (n, m, p) at ``thetas`` (n, p); errors as of :meth:`values`."""
        if not isinstance(self._map, FEMForward):
            self._answered(self._predict(thetas))
            return np.asarray(self._derivatives(thetas))
        predicted, sensitivities = self._map.slopes_all(thetas)
        self._answered(predicted)
        return np.asarray(self._derivatives_along(predicted.displacement, sensitivities, thetas))

    def _answered(self, predicted: Prediction) -> Prediction:
        """Return the predictions; :class:`InputError` where one is not valid."""
        invalid = ~np.asarray(predicted.valid)
        if invalid.any():
            raise InputError(
                f"{self._what}: {self._map.label} has no answer at {invalid.sum()} of "
                f"{len(invalid)} theta"
            )
        return predicted

    @cached_property
    def _predict(self) -> Callable[[jax.Array], Prediction]:
        if isinstance(self._map, FEMForward):
            return self._map.evaluate_all
        return jax.jit(lambda t: jax.lax.map(self._map.evaluate, t, batch_size=_AT_ONCE))

    @cached_property
    def _values(self) -> Callable[[jax.Array, jax.Array], jax.Array]:
        return jax.jit(jax.vmap(self.of))

    @cached_property
    def _derivatives(self) -> Callable[[jax.Array], jax.Array]:
        slope = jax.jacfwd(lambda theta: self.of(self._map(theta), theta))
        return jax.jit(lambda thetas: jax.lax.map(slope, thetas))

    @cached_property
    def _derivatives_along(self) -> Callable[..., jax.Array]:
        """Return derivatives (n, m, p), by ``u`` (n, k, 3), du/dtheta (n, p, k, 3) and theta."""

        def one(u: jax.Array, sensitivity: jax.Array, theta: jax.Array) -> jax.Array:
            along = lambda *tangents: jax.jvp(self.of, (u, theta), tangents)[1]  # noqa: E731
            return jax.vmap(along, out_axes=-1)(sensitivity, jnp.eye(len(theta)))

        return jax.jit(jax.vmap(one))


def on_finer(error: MeshError, observe: Observations) -> Observations:
    """Return the same observations of the body on the finer mesh.

    :class:`InputError` for an observation that is not of a registered kind.
    """
    return observations_from_json(error.finer.scene, observe.to_json())


def mesh_errors(
    error: MeshError, estimate: MeshErrorEstimate, observe: str | None = None, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Return the value and the mesh's error of each observation, by name.

    error, estimate : the simulators on both meshes, and their displacements at one theta.
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
    coarse = parse_observation(scene, observe, seed)
    fine = on_finer(error, coarse)
    theta = estimate.theta[None]
    values = coarse(estimate.coarse[coarse.nodes][None], theta)
    finer = fine(estimate.fine[fine.nodes][None], theta)
    rows = {}
    for name, part in coarse.parts.items():
        both = (values[name], values[name] - finer[name])
        # One number is taken as it is; several give their root mean square.
        size, difference = (float(np.sqrt(np.mean(v**2)) if np.ndim(v) else v) for v in both)
        rows[name] = {
            "unit": part.unit,
            "value": size,
            "error": difference,
            "relative": abs(difference) / abs(size) if size else float("nan"),
        }
    return rows
