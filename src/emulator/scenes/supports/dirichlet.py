r"""Prescribed displacements: fixed ones, and ones whose amount is a parameter.

.. math:: u = \bar u + \sum_k \theta_k\, d_k

at prescribed components, with the fixed displacement :math:`\bar u` in mm and the displacement
:math:`d_k` in mm per unit of the amount :math:`\theta_k`, such as the amount of shear of a cube
between plates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import ClassVar, NamedTuple, override

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh, frozen_array
from emulator.scenes.part import Values
from emulator.scenes.supports.boundary_condition import BoundaryCondition, Held, Resisted

_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class Support(BoundaryCondition):
    """Displacement of a node set held at a value, in all its components or in some.

    Parameters
    ----------
    node_set : name of the set.
    displacement : in mm, (3,), or in Python (k, 3), one row a node of the set; zero clamps it.
    components : which of ``xyz`` are held; the others stay free, whatever their ``displacement``.
    amount : name of a parameter, without a unit, that multiplies ``displacement``; without it, the
        displacement is fixed. A plate that moves by 10 mm times ``shear``, say, shears a cube of
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

    @override
    def to_json(self) -> None:
        """Return nothing: :meth:`held` describes the support."""

    @override
    def held(self, mesh: Mesh) -> Held:
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

    @override
    def on_finer(self, mesh: Mesh, displacements: Mapping[str | None, np.ndarray]) -> Support:
        if self.displacement.ndim == 1:
            return self
        return replace(self, displacement=displacements[self.amount][mesh.node_set(self.node_set)])

    @override
    def resisted(self, mesh: Mesh) -> Resisted:
        _, nodes, _, axes, _ = self.held(mesh)
        points = np.repeat(mesh.nodes[nodes], len(axes), axis=0)
        return Resisted(points, np.tile(np.eye(3)[axes], (len(nodes), 1)))


class Prescribed(NamedTuple):
    """The displacements that all supports of a scene prescribe.

    held : (n, 3) bool, the components that are prescribed.
    displacement : their fixed part, (n, 3) mm, zero elsewhere.
    per_unit : (n, 3) mm per unit of a parameter, by the parameter's name.
    """

    held: np.ndarray
    displacement: np.ndarray
    per_unit: Mapping[str, np.ndarray]

    @property
    def moves(self) -> bool:
        """Whether any prescribed displacement differs from zero."""
        return bool(self.displacement.any()) or bool(self.per_unit)

    def at(self, values: Values, rows: slice | np.ndarray = slice(None)) -> jax.Array:
        """Return the displacement (..., k, 3) mm of nodes ``rows`` at amounts ``values`` (...)."""
        u = jnp.asarray(self.displacement[rows])
        for name, per_unit in self.per_unit.items():
            u = u + jnp.asarray(values[name])[..., None, None] * per_unit[rows]
        return u


def prescribe(mesh: Mesh, supports: Sequence[BoundaryCondition]) -> Prescribed:
    """Return what all ``supports`` prescribe.

    Raises
    ------
    InputError
        Two supports prescribe different values at a node that they share.
    """
    components = np.zeros(mesh.nodes.shape, dtype=bool)
    prescribed = [each for support in supports if (each := support.held(mesh)) is not None]
    amounts = (None, *dict.fromkeys(each.amount for each in prescribed if each.amount))
    totals = {amount: np.zeros(mesh.nodes.shape) for amount in amounts}
    for where, nodes, displacement, axes, own in prescribed:
        for axis in axes:
            for amount, total in totals.items():
                value = displacement[:, axis] if amount == own else np.zeros(len(nodes))
                clash = np.flatnonzero(components[nodes, axis] & (total[nodes, axis] != value))
                if len(clash):
                    node, times = nodes[clash[0]], f" times {amount}" if amount else ""
                    raise InputError(
                        f"support on '{where}' contradicts another one at node {node}: "
                        f"{_AXES[axis]} is {total[node, axis]:g} mm{times} there, "
                        f"not {value[clash[0]]:g}"
                    )
                total[nodes, axis] = value
            components[nodes, axis] = True
    fixed = frozen_array(totals.pop(None))
    per_unit = {str(name): frozen_array(total) for name, total in totals.items() if total.any()}
    return Prescribed(frozen_array(components, bool), fixed, MappingProxyType(per_unit))
