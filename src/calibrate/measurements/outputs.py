"""Numbers that a forward map predicts for observations, and their derivatives in theta."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.protocol import Observation
from calibrate.measurements.several import observations
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
    """What a forward map says that is observed: all numbers, one after the other.

    Programs are compiled once.

    Parameters
    ----------
    parts : observations, by name. field : whether to observe every node's displacement, too.
    what : begins the line of a refusal.

    places : of each observation's numbers, and of the field's, by name. nodes : of the map, (k,).
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
        place = {int(node): k for k, node in enumerate(nodes)}
        self._rows = {
            name: np.array([place[int(node)] for node in part.nodes], dtype=int)
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
        """Numbers (m,) of the displacement ``u`` (k, 3) mm."""
        found = [jnp.ravel(part(u[self._rows[name]], theta)) for name, part in self._parts.items()]
        if self._field:
            square = jnp.sum(u**2, axis=-1)
            # The derivative of a length is not defined where a node is held.
            moved = square > 0.0
            found.append(jnp.where(moved, jnp.sqrt(jnp.where(moved, square, 1.0)), 0.0))
        return jnp.concatenate(found)

    def values(self, thetas: jax.Array) -> np.ndarray:
        """Numbers (n, m) at ``thetas`` (n, p).

        Raises
        ------
        InputError
            The map has no answer at one of them.
        """
        predicted = self._predict(thetas)
        require_answers(self._map, predicted, self._what)
        return np.asarray(self._values(predicted.displacement, thetas))

    def slopes(self, thetas: jax.Array) -> np.ndarray:
        """Derivatives (n, m, p) at ``thetas`` (n, p).

        Raises
        ------
        InputError
            The map has no answer at one of them.
        """
        if not isinstance(self._map, SolvingMap):
            require_answers(self._map, self._predict(thetas), self._what)
            return np.asarray(self._derivatives(thetas))
        predicted, moved = self._map.slopes_all(thetas)
        require_answers(self._map, predicted, self._what)
        return np.asarray(self._derivatives_along(predicted.displacement, moved, thetas))

    def _along(self, u: jax.Array, moved: jax.Array, theta: jax.Array) -> jax.Array:
        """Derivatives (m, p) at ``theta`` (p,), from ``u`` (k, 3) and du/dtheta (p, k, 3)."""

        def along(du: jax.Array, direction: jax.Array) -> jax.Array:
            return jax.jvp(self.of, (u, theta), (du, direction))[1]

        return jax.vmap(along, out_axes=-1)(moved, jnp.eye(len(theta)))

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
