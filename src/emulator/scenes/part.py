"""What loads and supports share: fields with one meaning, and sums of local contributions.

A load or support that depends on the displacement is a sum over small groups of nodes, one for each
facet or element: of energies, or of forces without a potential. Assembly adds their Hessians (or
Jacobians) to the tangent in the way of the element blocks.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from emulator.mechanics.laws.law import Quantity, number

Values = Mapping[str, jax.Array]
"""Parameters and constants of a scene by name."""


@dataclass(frozen=True, eq=False)
class LocalTerm:
    """A sum of local energies.

    nodes : the nodes (k, a) that each local energy depends on.
    data : the arrays with leading axis k, of NumPy, because JAX's made inside jit are tracers.
    energy : ``energy(u, data_row, values) -> ()``, the energy in mN mm of one group, ``u`` (a, 3).
    convex : whether every local energy is convex. Its stiffness then helps an iteration that starts
        far from equilibrium.
    """

    nodes: np.ndarray
    data: Any
    energy: Callable[[jax.Array, Any, Values], jax.Array]
    convex: bool = False

    def total(self, u: jax.Array, values: Values) -> jax.Array:
        """Return the sum, shape ()."""
        return jnp.sum(jax.vmap(lambda v, d: self.energy(v, d, values))(u[self.nodes], self.data))

    def tangents(self, u: jax.Array, values: Values) -> jax.Array:
        """Return the Hessians (k, 3a, 3a) of the local energies."""
        hessian = jax.vmap(lambda v, d: jax.hessian(self.energy)(v, d, values))
        return _square(hessian(u[self.nodes], self.data), self.nodes)


@dataclass(frozen=True, eq=False)
class LocalForce:
    """A sum of local forces that have no potential.

    nodes : the nodes (k, a) that each local force acts on and depends on.
    data : the NumPy arrays with leading axis k.
    force : ``force(u, data_row, values) -> (a, 3)``, the forces in mN of one group, ``u`` (a, 3).
    """

    nodes: np.ndarray
    data: Any
    force: Callable[[jax.Array, Any, Values], jax.Array]

    def total(self, u: jax.Array, values: Values) -> jax.Array:
        """Return the nodal force (n, 3) in mN."""
        forces = jax.vmap(lambda v, d: self.force(v, d, values))(u[self.nodes], self.data)
        return jnp.zeros_like(u).at[self.nodes].add(forces)

    def tangents(self, u: jax.Array, values: Values) -> jax.Array:
        """Return the derivatives (k, 3a, 3a) of minus the local forces, not symmetric."""
        jacobian = jax.vmap(lambda v, d: -jax.jacfwd(self.force)(v, d, values))
        return _square(jacobian(u[self.nodes], self.data), self.nodes)


def _square(blocks: jax.Array, nodes: np.ndarray) -> jax.Array:
    size = 3 * nodes.shape[1]
    return blocks.reshape(-1, size, size)


@dataclass(frozen=True, eq=False)
class Part(ABC):
    """A load or a support: a frozen dataclass whose fields are the keys of its table in a file.

    Fields of these names mean the same in every part:

    facet_set : the surface that the part acts on.
    parameter : the name of the parameter that stands for :attr:`magnitude` where this is None.
    amount : the name of a parameter without a unit by which a vector is multiplied, or None.
    """

    kind: ClassVar[str]
    """Name in scene files and in the registry."""
    magnitude: ClassVar[Quantity | None] = None
    """Name, unit and admissible values of the field that is a number, or None for a parameter."""

    @property
    def known(self) -> float | None:
        """The magnitude where it is a number; None where it is a parameter, or there is none."""
        return None if self.magnitude is None else vars(self)[self.magnitude.name]

    def value(self, values: Values) -> jax.Array | float:
        """Return the magnitude in its unit, from ``values`` where it is a parameter."""
        return values[vars(self)["parameter"]] if self.known is None else self.known

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The parameters that the part takes from theta or from the scene's constants."""
        if self.magnitude is not None and self.known is None:
            return (replace(self.magnitude, name=vars(self)["parameter"]),)
        amount = vars(self).get("amount")
        return () if amount is None else (number(amount, -np.inf),)

    @property
    def facet_sets(self) -> tuple[str, ...]:
        """The facet sets that the part acts on, which the mesh must have."""
        facet_set = vars(self).get("facet_set")
        return () if facet_set is None else (facet_set,)

    @property
    def simpler(self) -> tuple[str, Any] | None:
        """The effect that can be left out, and the part without it, None for no part; or None."""
        return None

    def to_json(self) -> list[Any] | None:
        """Return kind and every field as plain JSON, for fingerprints; or None for nothing.

        Numbers are floats, -0.0 is 0.0, and the entries of a tuple stand one by one. The name of
        the parameter is None where the magnitude is a number.
        """
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        if self.known is not None:
            values["parameter"] = None
        entries: list[Any] = [self.kind]
        for value in values.values():
            for entry in value if isinstance(value, tuple) else (value,):
                numeric = isinstance(entry, int | float) and not isinstance(entry, bool)
                entries.append(float(entry) + 0.0 if numeric else entry)
        return entries
