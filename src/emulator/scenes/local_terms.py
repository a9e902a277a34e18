"""Sums of local contributions of small node groups: energies, or forces without a potential.

Supports and loads are built of them, one for each facet; assembly adds their Hessians (or
Jacobians) to the tangent as it does the element blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Values = Mapping[str, jax.Array]


@dataclass(frozen=True, eq=False)
class LocalTerm:
    """A sum of local energies.

    nodes : (k, a) nodes each local energy depends on.
    data : arrays with leading axis k; NumPy's, because JAX arrays made inside jit are tracers.
    energy : ``energy(u, data_row, values) -> ()`` in mN mm for one of them, ``u`` (a, 3).
    convex : whether each of them is. Its stiffness then helps a body that does not balance it yet.
    """

    nodes: np.ndarray
    data: Any
    energy: Callable[[jax.Array, Any, Values], jax.Array]
    convex: bool = False

    def total(self, u: jax.Array, values: Values) -> jax.Array:
        """The sum, shape ()."""
        return jnp.sum(jax.vmap(lambda v, d: self.energy(v, d, values))(u[self.nodes], self.data))

    def tangents(self, u: jax.Array, values: Values) -> jax.Array:
        """Hessians (k, 3a, 3a) of the local energies."""
        hessian = jax.vmap(lambda v, d: jax.hessian(self.energy)(v, d, values))
        return _square(hessian(u[self.nodes], self.data), self.nodes)


@dataclass(frozen=True, eq=False)
class LocalForce:
    """A sum of local forces that have no potential.

    nodes : (k, a) nodes that each local force acts on and depends on.
    data : NumPy arrays with leading axis k.
    force : ``force(u, data_row, values) -> (a, 3)`` in mN for one of them, ``u`` (a, 3).
    """

    nodes: np.ndarray
    data: Any
    force: Callable[[jax.Array, Any, Values], jax.Array]

    def total(self, u: jax.Array, values: Values) -> jax.Array:
        """Nodal force (n, 3) in mN."""
        forces = jax.vmap(lambda v, d: self.force(v, d, values))(u[self.nodes], self.data)
        return jnp.zeros_like(u).at[self.nodes].add(forces)

    def tangents(self, u: jax.Array, values: Values) -> jax.Array:
        """Derivatives (k, 3a, 3a) of minus the local forces, not symmetric."""
        jacobian = jax.vmap(lambda v, d: -jax.jacfwd(self.force)(v, d, values))
        return _square(jacobian(u[self.nodes], self.data), self.nodes)


def _square(blocks: jax.Array, nodes: np.ndarray) -> jax.Array:
    size = 3 * nodes.shape[1]
    return blocks.reshape(-1, size, size)
