r"""Pressures on a surface; positive ones push into the tissue.

With the normals of the facets pointing out of the tissue and :math:`x = X + u`:

* :class:`CavityPressure`: exact for a cavity that is closed at a rim which does not move. The
  pressure does work on the volume alone,

  .. math:: \Pi_p = -p\,[V(u) - V(0)], \qquad
            V = -\frac{1}{3} \int x \cdot n \, da + \text{lid} .

  The lid is fixed and drops out. A rim may also slide in a plane of symmetry through the origin:
  the cone over the opening, from the origin, then has no volume.

* :class:`ValvePressure`: on the wall of a cavity and on lids over all its openings, such as closed
  valves. The work is that on the volume, with lids that move with their rims,
  :math:`\Pi_p = -p\,[V(u) - V(0)]`, so the rims are free to move.

* :class:`FollowerPressure`: on an open patch, by its virtual work,

  .. math::
      f_a = -p \int N_a(\xi) \,
          \frac{\partial x}{\partial \xi} \times \frac{\partial x}{\partial \eta} \; d\xi\, d\eta .

  Unless the rim of the patch is fixed, no potential has this force: its tangent is not symmetric,
  and a scene with it can be simulated but has no energy to train on.

* :class:`DeadPressure`: keeps the direction and the area of the stress-free surface,
  :math:`\Pi_p = p \int u \cdot N \, dA`: the pressure to first order in the displacement.

* :class:`PublishedPressure`: the work of the released code, for reproducing it,

  .. math:: \Pi_p = p \int u \cdot \text{cof}(F) N \, dA ,

  differentiated through :math:`\text{cof}(F)` too. It is no follower pressure: on the released
  ventricle it acts like a pressure 1.39 times larger.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, override

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.units import KPA_PER_MMHG
from emulator.geometry.discretisation import Discretisation, FacetRule, facet_rule
from emulator.geometry.facets import Cavity, cone_volume, lids, nodal_area_vectors, rim
from emulator.geometry.mesh import Mesh
from emulator.mechanics.kinematics import cofactor
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.part import Load, LocalForce, LocalTerm, Prescribed, Values, sums
from emulator.scenes.tissue import Fibres


@dataclass(frozen=True)
class SurfacePressure(Load):
    """A pressure on a facet set; subclasses define its virtual work.

    Parameters
    ----------
    facet_set : the surface it acts on.
    pressure : kPa; without it, the pressure is a parameter of the scene.
    parameter : name of that parameter; give each of several pressures its own.
    """

    magnitude: ClassVar[Quantity] = Quantity(
        "pressure", "kPa", -np.inf, hint=f"1 mmHg = {KPA_PER_MMHG} kPa"
    )

    facet_set: str
    pressure: float | None = None
    parameter: str = "pressure"

    def __post_init__(self) -> None:
        if self.pressure is not None and not np.isfinite(self.pressure):
            raise InputError(f"pressure on '{self.facet_set}' is {self.pressure} kPa")

    @property
    def pressed(self) -> str:
        """The facet set it acts on."""
        return self.facet_set

    def _facets(self, grid: Discretisation) -> tuple[np.ndarray, np.ndarray, FacetRule]:
        """Return facets (k, a), their nodes (k, a, 3), and a rule for N_a times an area vector."""
        mesh = grid.mesh
        facets = mesh.facet_set(self.facet_set)
        degree = 1 if mesh.order == 1 else 4
        return facets, mesh.nodes[facets], facet_rule(mesh.order, degree)


@dataclass(frozen=True)
class DeadPressure(SurfacePressure):
    """Pressure on the surface at rest; positive pushes into the tissue."""

    kind: ClassVar[str] = "dead_pressure"

    @override
    def dead_forces(self, grid: Discretisation) -> Mapping[str | None, np.ndarray]:
        facets, corners, rule = self._facets(grid)
        areas, count = -nodal_area_vectors(corners, rule), len(grid.mesh.nodes)
        xp = areas.__array_namespace__()
        per_kpa = xp.stack([sums(count, facets, areas[..., i]) for i in range(3)], axis=1)
        known = self.pressure
        return {self.parameter: per_kpa} if known is None else {None: known * per_kpa}

    @override
    def on_loaded(
        self, grid: Discretisation, fibres: Fibres | None = None
    ) -> tuple[LocalForce, ...]:
        # The surface at rest is x + w: as a pressure that follows w.
        return (FollowerPressure(**vars(self)).force(grid),)


class FollowingPressure(SurfacePressure):
    """A pressure that follows the surface."""

    @property
    def simpler(self) -> tuple[str, DeadPressure]:
        """The pressure on the surface as it is at rest."""
        return f"pressure that follows '{self.facet_set}'", DeadPressure(**vars(self))


@dataclass(frozen=True)
class FollowerPressure(FollowingPressure):
    """Pressure on a patch whose rim may move; positive pushes into the tissue."""

    kind: ClassVar[str] = "follower_pressure"
    has_potential: ClassVar[bool] = False

    @override
    def force(self, grid: Discretisation) -> LocalForce:
        facets, corners, rule = self._facets(grid)

        def force(u: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            return -self.value(values) * nodal_area_vectors(corners + u, rule)

        return LocalForce(facets, corners, force)

    @override
    def on_loaded(
        self, grid: Discretisation, fibres: Fibres | None = None
    ) -> tuple[LocalForce, ...]:
        following = self.force(grid)

        def force(w: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            return following.force(jnp.zeros_like(w), corners, values)

        return (replace(following, force=force),)


@dataclass(frozen=True)
class CavityPressure(FollowingPressure):
    """Pressure in a cavity, exact (``-p V``); the rim of its wall must be held."""

    kind: ClassVar[str] = "cavity_pressure"

    @property
    def at_held_nodes(self) -> FollowerPressure:
        """The pressure on the wall alone: the part of the lid in ``V`` acts on the fixed rim."""
        return FollowerPressure(**vars(self))

    @override
    def check(self, mesh: Mesh, prescribed: Prescribed) -> None:
        """Refuse a cavity whose rim is neither fixed nor slides in a plane through the origin."""
        edges = rim(mesh.facet_set(self.facet_set))
        fixed = prescribed.held[edges]  # (e, 2 or 3, 3)
        _, displacement, per_unit = prescribed
        largest = sum(map(np.abs, per_unit.values()), np.abs(displacement))
        positions = np.where(fixed, mesh.nodes[edges] + largest[edges], np.nan)
        in_symmetry_plane = (np.abs(positions) <= 1e-9 * mesh.size).all(axis=1).any(axis=1)
        loose = np.unique(edges[~(fixed.all(axis=(1, 2)) | in_symmetry_plane)])
        if loose.size:
            raise InputError(
                f"cavity '{self.facet_set}': rim node {loose[0]} ({loose.size} such) is not held, "
                "so -p V is not the potential of its pressure; hold the rim or use FollowerPressure"
            )

    @override
    def terms(self, grid: Discretisation, fibres: Fibres | None = None) -> tuple[LocalTerm, ...]:
        facets = grid.mesh.facet_set(self.facet_set)

        def energy(u: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            return -self.value(values) * (cone_volume(corners) - cone_volume(corners + u))

        return (LocalTerm(facets, grid.mesh.nodes[facets], energy),)

    @override
    def on_loaded(
        self, grid: Discretisation, fibres: Fibres | None = None
    ) -> tuple[LocalForce, ...]:
        return self.at_held_nodes.on_loaded(grid)


@dataclass(frozen=True)
class ValvePressure(FollowingPressure):
    """Pressure in a cavity whose openings are closed by valves that carry it, too.

    A valve is a flat lid, a fan from the middle of its rim, and pulls on the rim.
    """

    kind: ClassVar[str] = "valve_pressure"

    @override
    def check(self, mesh: Mesh, prescribed: Prescribed) -> None:
        """Refuse a surface that encloses nothing."""
        Cavity(mesh, self.facet_set)

    @override
    def terms(self, grid: Discretisation, fibres: Fibres | None = None) -> tuple[LocalTerm, ...]:
        return (*CavityPressure(**vars(self)).terms(grid), *self._of_lids(grid))

    @override
    def on_loaded(
        self, grid: Discretisation, fibres: Fibres | None = None
    ) -> tuple[LocalForce, ...]:
        return tuple(self._at_rest(term) for term in self.terms(grid))

    def _at_rest(self, term: LocalTerm) -> LocalForce:
        """Return the force of a potential at its places at rest, whatever the displacement."""
        with jax.ensure_compile_time_eval():  # a constant that compilers would take minutes to fold
            values = {self.parameter: jnp.ones(())}
            zero = jnp.zeros((*term.nodes.shape, 3))
            slopes = jax.jit(jax.vmap(jax.grad(lambda u, data: term.energy(u, data, values))))
            forces = -np.asarray(slopes(zero, term.data))

        def force(_: jax.Array, at_rest: jax.Array, values: Values) -> jax.Array:
            return at_rest if self.known is not None else values[self.parameter] * at_rest

        return LocalForce(term.nodes, forces, force)

    def _of_lids(self, grid: Discretisation) -> list[LocalTerm]:
        """Return the potential of the pressure on each lid, one group of all nodes of its rim."""
        mesh = grid.mesh
        terms = []
        for rim_nodes, fan in lids(mesh.facet_set(self.facet_set)):

            def energy(
                u: jax.Array, at_rest: jax.Array, values: Values, fan: Callable = fan
            ) -> jax.Array:
                cones = cone_volume(fan(at_rest)) - cone_volume(fan(at_rest + u))
                return -self.value(values) * cones.sum()

            terms.append(LocalTerm(rim_nodes[None], mesh.nodes[rim_nodes][None], energy))
        return terms


@dataclass(frozen=True)
class PublishedPressure(SurfacePressure):
    """The released pressure work; ``F`` of each facet is that of the element behind it."""

    kind: ClassVar[str] = "published_pressure"

    @override
    def check(self, mesh: Mesh, prescribed: Prescribed) -> None:
        """Refuse quadratic tetrahedra, on which the released work is not defined."""
        if mesh.order != 1:
            raise InputError(
                f"pressure on '{self.facet_set}': the published work is defined on linear "
                "tetrahedra; use CavityPressure on quadratic ones"
            )

    @override
    def terms(self, grid: Discretisation, fibres: Fibres | None = None) -> tuple[LocalTerm, ...]:
        mesh = grid.mesh
        facets = mesh.facet_set(self.facet_set)
        behind = mesh.elements_behind(facets)
        corner = mesh.nodes[facets]
        area = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        nodes = mesh.elements[behind]
        on_facet = (nodes[:, :, None] == facets[:, None, :]).any(axis=2)
        data = (area, on_facet / 3.0, grid.gradients[behind, 0])

        def energy(u: jax.Array, data: Any, values: Values) -> jax.Array:
            area, mean, gradients = data
            F = jnp.eye(3, dtype=u.dtype) + u.T @ gradients
            return self.value(values) * jnp.vdot(mean @ u, cofactor(F) @ area)

        return (LocalTerm(nodes, data, energy),)
