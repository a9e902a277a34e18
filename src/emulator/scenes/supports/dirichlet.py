r"""Prescribed displacements: fixed ones, and ones whose amount is a parameter.

.. math:: u = \bar u + \sum_k \theta_k\, d_k \qquad\text{where held,}

with the fixed displacement :math:`\bar u` in mm and the displacement :math:`d_k` in mm per unit of
the amount :math:`\theta_k`, such as the amount of shear of a cube between plates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh, frozen_array
from emulator.mechanics.laws.law import Quantity, number
from emulator.scenes.local_terms import Values
from emulator.scenes.supports.boundary_condition import BoundaryCondition, Held, Resisted

_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class Support(BoundaryCondition):
    """Displacement of a node set held at a value, in all its components or in some.

    Parameters
    ----------
    node_set : name of the set.
    displacement : (3,) or (k, 3) in mm, one row a node of the set; zero clamps it.
    components : which of ``xyz`` are held; the others stay free, whatever their ``displacement``.
    amount : name of a parameter, without a unit, that ``displacement`` is multiplied by; ``None``
        for a fixed displacement. A plate that moves by 10 mm times ``shear``, say, shears a cube of
        10 mm between it and another plate by ``shear``.
    """

    kind: ClassVar[str] = "held"

    node_set: str
    displacement: np.ndarray = field(default_factory=lambda: np.zeros(3))
    components: str = _AXES
    amount: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "displacement", frozen_array(self.displacement))
        if not self.components or set(self.components) - set(_AXES):
            raise InputError(
                f"support on '{self.node_set}': components '{self.components}'; "
                "name some of x, y and z"
            )

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The amount, where it is a parameter; either sign."""
        return () if self.amount is None else (number(self.amount, -np.inf),)

    def held(self, mesh: Mesh) -> Held:
        """The nodes of the set, their displacements, and the axes that are held."""
        nodes = mesh.node_set(self.node_set)
        if not np.isfinite(self.displacement).all():
            raise InputError(f"support on '{self.node_set}': displacement is not finite")
        if self.displacement.shape not in ((3,), (len(nodes), 3)):
            raise InputError(
                f"support on '{self.node_set}': displacement has shape "
                f"{self.displacement.shape}; expected (3,) or ({len(nodes)}, 3)"
            )
        axes = [k for k, axis in enumerate(_AXES) if axis in self.components]
        every = np.broadcast_to(self.displacement, (len(nodes), 3))
        return Held(self.node_set, nodes, every, axes, self.amount)

    def on_finer(self, mesh: Mesh, moved: Mapping[str | None, np.ndarray]) -> Support:
        """Nodes between held ones move between them."""
        if self.displacement.ndim == 1:
            return self
        return replace(self, displacement=moved[self.amount][mesh.node_set(self.node_set)])

    def resisted(self, mesh: Mesh) -> Resisted:
        """Every node of the set along each axis that is held."""
        _, nodes, _, axes, _ = self.held(mesh)
        points = np.repeat(mesh.nodes[nodes], len(axes), axis=0)
        return Resisted(points, np.tile(np.eye(3)[axes], (len(nodes), 1)))


class Prescribed(NamedTuple):
    """The displacements that supports prescribe.

    held : where the displacement is known, (n, 3) bool.
    displacement : its fixed part, (n, 3) mm, zero elsewhere.
    per_unit : (n, 3) mm per unit of a parameter, by the parameter's name.
    """

    held: np.ndarray
    displacement: np.ndarray
    per_unit: Mapping[str, np.ndarray]

    @property
    def moves(self) -> bool:
        """Whether anything is held elsewhere than at rest."""
        return bool(self.displacement.any()) or bool(self.per_unit)

    def at(self, values: Values, rows: slice | np.ndarray = slice(None)) -> jax.Array:
        """The displacement (..., k, 3) mm of nodes ``rows`` where amounts are ``values`` (...)."""
        found = jnp.asarray(self.displacement[rows])
        for name, moved in self.per_unit.items():
            found = found + jnp.asarray(values[name])[..., None, None] * moved[rows]
        return found


def prescribe(mesh: Mesh, supports: Sequence[BoundaryCondition]) -> Prescribed:
    """What all ``supports`` prescribe.

    Raises
    ------
    InputError
        Two supports hold a shared node at different values.
    """
    held = np.zeros(mesh.nodes.shape, dtype=bool)
    moving = (support.held(mesh) for support in supports)
    prescribed = [each for each in moving if each is not None]
    amounts = (None, *dict.fromkeys(each.amount for each in prescribed if each.amount))
    parts = {amount: np.zeros(mesh.nodes.shape) for amount in amounts}
    for where, nodes, wanted, axes, own in prescribed:
        for axis in axes:
            for amount, part in parts.items():
                here = wanted[:, axis] if amount == own else np.zeros(len(nodes))
                clash = np.flatnonzero(held[nodes, axis] & (part[nodes, axis] != here))
                if len(clash):
                    node, times = nodes[clash[0]], f" times {amount}" if amount else ""
                    raise InputError(
                        f"support on '{where}' contradicts another one at node {node}: "
                        f"{_AXES[axis]} is {part[node, axis]:g} mm{times} there, "
                        f"not {here[clash[0]]:g}"
                    )
                part[nodes, axis] = here
            held[nodes, axis] = True
    fixed = frozen_array(parts.pop(None))
    per_unit = {str(name): frozen_array(part) for name, part in parts.items() if part.any()}
    return Prescribed(frozen_array(held, bool), fixed, MappingProxyType(per_unit))
