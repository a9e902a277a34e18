r"""Elastic (Robin) supports: springs spread over a surface, and dashpots.

.. math:: \Pi_s = \frac{k}{2} \int |u|^2\, dA \quad\text{or}\quad
          \frac{k}{2} \int (u \cdot N)^2\, dA

over the reference surface, with the stiffness ``k`` in kPa/mm and the outward normal ``N``. A clamp
that gives is such a support whose stiffness is inferred. Dashpots resist the velocity v in mm/s as
springs resist u: their force is minus the derivative of :math:`\tfrac{c}{2} \int |v|^2\, dA` in v,
with c in kPa s/mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal, override

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation, FacetRule, facet_rule
from emulator.geometry.facets import area_vectors
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.part import BoundaryCondition, LocalForce, LocalTerm, Values


class OnSurface(BoundaryCondition):
    """A support that resists, over a facet set, displacements or velocities; see its kinds."""

    facet_set: str
    direction: Literal["all", "normal"]
    noun: ClassVar[str]
    """The word for what resists."""

    def __post_init__(self) -> None:
        magnitude = self.magnitude
        assert magnitude is not None
        if self.known is not None and not 0.0 < self.known < np.inf:
            raise InputError(
                f"{self.kind} support on '{self.facet_set}': {magnitude.name} is {self.known} "
                f"{magnitude.unit}; it must be above 0"
            )
        if self.direction not in ("all", "normal"):
            raise InputError(
                f"{self.kind} support on '{self.facet_set}': direction '{self.direction}'; "
                "use all or normal"
            )

    @property
    def simpler(self) -> tuple[str, None]:
        """The surface without it."""
        way = "" if self.direction == "all" else "normal "
        return f"{way}{self.noun} on '{self.facet_set}'", None

    @override
    def to_json(self) -> list[Any] | None:
        """Return kind and fields, without ``parameter`` where the magnitude is known."""
        every = super().to_json() or []
        return every if self.known is None else every[:-1]

    def quadratic(self, grid: Discretisation) -> LocalTerm:
        """Return half the magnitude times the integral of the squares, facet by facet."""
        facets, corners, rule = self._facets(grid.mesh)
        return LocalTerm(facets, area_vectors(corners, rule), partial(self._half_square, rule))

    def _facets(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray, FacetRule]:
        """Return facets (k, a), their nodes (k, a, 3), and a rule for the degree of ``|u|^2``."""
        facets = mesh.facet_set(self.facet_set)
        return facets, mesh.nodes[facets], facet_rule(mesh.order, 2 * mesh.order)

    def _half_square(
        self, rule: FacetRule, u: jax.Array, normals: jax.Array, values: Values
    ) -> jax.Array:
        """Return :meth:`quadratic` of a facet with area vectors ``normals`` (q, 3) at rest, ()."""
        areas = jnp.sqrt(jnp.sum(normals**2, axis=1))
        at_points = rule.values @ u
        if self.direction == "normal":
            squared = (jnp.sum(at_points * normals, axis=1) / areas) ** 2
        else:
            squared = jnp.sum(at_points**2, axis=1)
        return 0.5 * self.value(values) * jnp.sum(rule.weights * areas * squared)

    @override
    def resisted(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of every facet, along all axes or along the facet's normal."""
        points = mesh.nodes[mesh.facet_set(self.facet_set)][:, :3]
        normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        if self.direction == "normal":
            return points.reshape(-1, 3), np.repeat(normal, 3, axis=0)
        every = points.reshape(-1, 3)
        return np.repeat(every, 3, axis=0), np.tile(np.eye(3), (len(every), 1))


@dataclass(frozen=True)
class ElasticSupport(OnSurface):
    """Springs on a facet set.

    Parameters
    ----------
    facet_set : the surface they act on.
    stiffness : k in kPa/mm, above 0; without it, the stiffness is a parameter of the scene.
    direction : ``all``, or ``normal`` to let the surface slide along itself.
    parameter : name of that parameter; give each of several supports its own.
    """

    kind: ClassVar[str] = "elastic"
    magnitude: ClassVar[Quantity] = Quantity("stiffness", "kPa/mm")
    noun: ClassVar[str] = "springs"

    facet_set: str
    stiffness: float | None = None
    direction: Literal["all", "normal"] = "all"
    parameter: str = "stiffness"

    @override
    def terms(self, grid: Discretisation) -> tuple[LocalTerm, ...]:
        return (self.quadratic(grid),)

    @override
    def on_loaded(self, grid: Discretisation) -> tuple[LocalForce, ...]:
        """Return the force of springs at rest with the body, on the surface at rest, ``x + w``."""
        facets, corners, rule = self._facets(grid.mesh)

        def force(w: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            normals = area_vectors(corners + w, rule)
            return -jax.grad(partial(self._half_square, rule))(-w, normals, values)

        return (LocalForce(facets, corners, force),)


@dataclass(frozen=True)
class Dashpots(OnSurface):
    """Dashpots on a facet set, of a scene that goes through time.

    Parameters
    ----------
    facet_set : the surface they act on.
    damping : c in kPa s/mm, above 0; without it, the damping is a parameter of the scene.
    direction : ``all``, or ``normal`` for the velocity along the surface's normal.
    parameter : name of that parameter; give each of several supports its own.
    """

    kind: ClassVar[str] = "dashpots"
    magnitude: ClassVar[Quantity] = Quantity("damping", "kPa s/mm")
    noun: ClassVar[str] = "dashpots"
    resists_velocity: ClassVar[bool] = True

    facet_set: str
    damping: float | None = None
    direction: Literal["all", "normal"] = "all"
    parameter: str = "damping"

    @override
    def resisted(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
        """Return nothing: dashpots let the body go anywhere."""
        return np.zeros((0, 3)), np.zeros((0, 3))
