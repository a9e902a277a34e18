r"""Elastic (Robin) supports: springs spread over a surface.

.. math:: \Pi_s = \frac{k}{2} \int |u|^2\, dA \quad\text{or}\quad
          \frac{k}{2} \int (u \cdot N)^2\, dA

over the reference surface, with the stiffness ``k`` in kPa/mm and the outward normal ``N``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.geometry.discretisation import Discretisation, facet_rule
from emulator.geometry.facets import area_vectors
from emulator.geometry.mesh import Mesh
from emulator.scenes.identity import plain_fields
from emulator.scenes.local_terms import LocalTerm, Values
from emulator.scenes.supports.boundary_condition import BoundaryCondition, Resisted


@dataclass(frozen=True)
class ElasticSupport(BoundaryCondition):
    """Springs on a facet set.

    Parameters
    ----------
    facet_set : the surface they act on.
    stiffness : k in kPa/mm, above 0.
    direction : ``all``, or ``normal`` to let the surface slide along itself.
    """

    kind: ClassVar[str] = "elastic"

    facet_set: str
    stiffness: float
    direction: Literal["all", "normal"] = "all"

    def __post_init__(self) -> None:
        if not 0.0 < self.stiffness < np.inf:
            raise InputError(
                f"elastic support on '{self.facet_set}': stiffness is {self.stiffness} kPa/mm; "
                "it must be above 0"
            )
        if self.direction not in ("all", "normal"):
            raise InputError(
                f"elastic support on '{self.facet_set}': direction '{self.direction}'; "
                "use all or normal"
            )

    @property
    def facet_sets(self) -> tuple[str, ...]:
        """The facet set it acts on."""
        return (self.facet_set,)

    @property
    def simpler(self) -> tuple[str, None]:
        """No springs."""
        way = "springs on" if self.direction == "all" else "normal springs on"
        return f"{way} '{self.facet_set}'", None

    def to_json(self) -> list[Any]:
        """Every field."""
        return plain_fields(self)

    def term(self, grid: Discretisation) -> LocalTerm:
        """Energy of the springs, facet by facet."""
        mesh = grid.mesh
        facets = mesh.facet_set(self.facet_set)
        rule = facet_rule(mesh.order, 2 * mesh.order)  # the degree of |u|^2
        normals = area_vectors(mesh.nodes[facets], rule)  # (k, q, 3)
        areas = np.linalg.norm(normals, axis=-1)
        data = (rule.weights * areas, normals / areas[..., None])

        def energy(u: jax.Array, data: Any, _: Values) -> jax.Array:
            weights, normal = data
            at_points = rule.values @ u
            if self.direction == "normal":
                squared = jnp.sum(at_points * normal, axis=1) ** 2
            else:
                squared = jnp.sum(at_points**2, axis=1)
            return 0.5 * self.stiffness * jnp.sum(weights * squared)

        return LocalTerm(facets, data, energy)

    def resisted(self, mesh: Mesh) -> Resisted:
        """The corners of every facet, along all axes or along its normal."""
        points = mesh.nodes[mesh.facet_set(self.facet_set)][:, :3]
        normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        if self.direction == "normal":
            return Resisted(points.reshape(-1, 3), np.repeat(normal, 3, axis=0))
        every = points.reshape(-1, 3)
        return Resisted(np.repeat(every, 3, axis=0), np.tile(np.eye(3), (len(every), 1)))
