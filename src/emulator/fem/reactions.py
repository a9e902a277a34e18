r"""Reactions: the forces of the supports on a body, and the resultant of one support.

Bulk forces :math:`f_\text{bulk} = \partial \Pi_\text{elastic} / \partial u` are internal and add up
to zero. At equilibrium loads and supports balance them at every node,

.. math:: f_\text{bulk} = f_\text{ext} + R , \qquad
          R = f_\text{bulk} - f_\text{ext} \;\text{(prescribed)}, \quad
          R = -\frac{\partial \Pi_s}{\partial u} \;\text{(springs)},

so the sum of all R is minus the resultant of the loads.

The resultant of one support along the unit vector d follows from the virtual displacement
:math:`\varphi` that moves the support's nodes by d and no others,

.. math:: R \cdot d = \Pi_\text{elastic}'(u)[\varphi] - f_\text{ext} \cdot \varphi
          \;\text{(prescribed)}, \qquad
          R \cdot d = -\Pi_s'(u)[\varphi] \;\text{(springs)},

in mN. Only elements (or patches of them), springs and loads at these nodes enter
(:class:`SupportForce`). It is the derivative of the least potential energy by the support's own
displacement along d, because the energy at equilibrium does not change with the free displacements
(envelope theorem).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled
from emulator.fem.energy import (
    at_points,
    dead_force,
    local_forces,
    local_terms,
    point_energy,
    spring_terms,
    strain_energy,
    with_mean_dilatation,
)
from emulator.geometry.discretisation import Blocks
from emulator.geometry.mesh import Mesh
from emulator.scenes.part import LocalForce, LocalTerm, Values
from emulator.scenes.scene import Scene


def balanced(scene: Scene) -> Scene:
    """Return ``scene`` with loads whose forces are right at prescribed nodes, too."""
    return replace(scene, loads=tuple(load.at_held_nodes for load in scene.loads))


@compiled
def reactions(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Return the force (n, 3) in mN of the supports on the body; zero where it is free.

    Springs count as supports.

    system : the equations of a :func:`balanced` scene.
    u : the equilibrium, (n, 3) mm.
    theta : the parameters, (p,).
    """
    bulk = jax.grad(strain_energy(system.scene))(u, theta)
    values = system.scene.resolve(theta)
    springs = jax.grad(lambda v: sum((s.total(v, values) for s in system.springs), 0.0))(u)
    prescribed = jnp.asarray(system.scene.held)
    return jnp.where(prescribed, bulk - system.external_force(u, theta), -springs)


def nodes_of(mesh: Mesh, name: str) -> np.ndarray:
    """Return the nodes (k,) of the node set or facet set ``name``, or raise :class:`InputError`."""
    if name not in mesh.node_sets and name in mesh.facet_sets:
        return np.unique(mesh.facet_set(name))
    return mesh.node_set(name)


def supported_sets(scene: Scene) -> dict[str, np.ndarray]:
    """Return the nodes (k,) of each support, by the name of its set."""
    sets: dict[str, np.ndarray] = {}
    for support in scene.supports:
        prescribed = support.held(scene.mesh)
        if prescribed is not None:
            sets[prescribed.where] = prescribed.nodes
        for name in support.facet_sets:
            sets[name] = nodes_of(scene.mesh, name)
    return sets


@dataclass(frozen=True, eq=False)
class SupportForce:
    """The resultant in mN along a direction of the reactions of one support.

    Parameters
    ----------
    scene : the scene that has the support.
    name : the name of the support's node set or facet set.
    direction : the direction (3,), which is normalised.

    Raises
    ------
    InputError
        No support of that name, one that does not act along the direction, or a direction of no
        length.
    """

    scene: Scene
    name: str
    direction: tuple[float, float, float]

    def __post_init__(self) -> None:
        direction = np.asarray(self.direction, dtype=float)
        if direction.shape != (3,) or not 0.0 < np.linalg.norm(direction) < np.inf:
            raise InputError(
                f"force of support '{self.name}': direction {self.direction}; give 3 numbers, "
                "not all 0"
            )
        unit = direction / np.linalg.norm(direction)
        object.__setattr__(self, "direction", tuple(map(float, unit)))
        supports = supported_sets(self.scene)
        if self.name not in supports:
            raise InputError(
                f"scene '{self.scene.name}' has no support on '{self.name}'; "
                f"it has {', '.join(supports)}"
            )
        prescribed, sprung = self._virtual
        if not prescribed.any() and not sprung.any():
            raise InputError(
                f"force of support '{self.name}': nothing is held along {self.direction} there"
            )

    @cached_property
    def _balanced(self) -> Scene:
        return balanced(self.scene)

    @cached_property
    def _virtual(self) -> tuple[np.ndarray, np.ndarray]:
        """The virtual displacement (n, 3) at prescribed displacements, and at springs."""
        at = nodes_of(self.scene.mesh, self.name)
        virtual = np.zeros(self.scene.held.shape)
        virtual[at] = self.direction
        sprung = np.zeros(len(virtual), dtype=bool)
        for spring in spring_terms(self.scene):
            sprung[spring.nodes] = True
        prescribed = self.scene.held
        return np.where(prescribed, virtual, 0.0), np.where(
            sprung[:, None] & ~prescribed, virtual, 0.0
        )

    @cached_property
    def _adjacent(self) -> np.ndarray:
        """The blocks that have a prescribed node of the support."""
        return np.flatnonzero(
            self._moves(self._virtual[0])[self._balanced.blocks.connectivity].any(1)
        )

    @cached_property
    def _bulk(self) -> Blocks:
        blocks = self._balanced.blocks
        connectivity = self._renumbered[blocks.connectivity[self._adjacent]]
        return Blocks(
            connectivity, blocks.gradients[self._adjacent], blocks.weights[self._adjacent]
        )

    @cached_property
    def _parts(self) -> tuple[list[LocalTerm], list[LocalForce], list[LocalTerm]]:
        """Potentials and forces of loads where prescribed, potentials of springs where free."""
        prescribed, sprung = self._virtual
        scene = self._balanced
        terms = _contributions_at(local_terms(scene), self._moves(prescribed))
        forces = _contributions_at(local_forces(scene), self._moves(prescribed))
        return terms, forces, _contributions_at(spring_terms(scene), self._moves(sprung))

    @staticmethod
    def _moves(virtual: np.ndarray) -> np.ndarray:
        return virtual.any(axis=1)

    @cached_property
    def nodes(self) -> np.ndarray:
        """The nodes (k,) whose displacement the force depends on."""
        parts = [part.nodes.ravel() for group in self._parts for part in group]
        return np.unique(
            np.concatenate([self._balanced.blocks.connectivity[self._adjacent].ravel(), *parts])
        )

    @cached_property
    def _renumbered(self) -> np.ndarray:
        position = np.full(len(self.scene.mesh.nodes), -1)
        position[self.nodes] = np.arange(len(self.nodes))
        return position

    def __call__(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the force (...) in mN from ``u`` (..., k, 3) mm of ``nodes`` and ``theta``."""
        return jnp.vectorize(self._force, signature="(k,i),(p)->()")(u, theta)

    def _force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        prescribed, sprung = (jnp.asarray(virtual[self.nodes]) for virtual in self._virtual)
        values = self._balanced.resolve(theta)
        terms, forces, springs = self._parts

        def potential_at_prescribed(v: jax.Array) -> jax.Array:
            loads = sum((t.total(v, values) for t in self._local(terms)), jnp.zeros(()))
            return self._strain_energy(v, theta) + loads

        def potential_of_springs(v: jax.Array) -> jax.Array:
            return sum((s.total(v, values) for s in self._local(springs)), jnp.zeros(()))

        force = jax.jvp(potential_at_prescribed, (u,), (prescribed,))[1]
        force = force - jax.jvp(potential_of_springs, (u,), (sprung,))[1]
        for follower in self._local(forces):
            force = force - jnp.vdot(follower.total(u, values), prescribed)
        return force - self._dead_work(values)

    def _strain_energy(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the energy () in mN mm of the blocks at the support."""
        blocks, scene = self._bulk, self._balanced
        H = jnp.einsum("bai,bqaj->bqij", u[blocks.connectivity], blocks.gradients)
        if scene.dilatation != "pointwise":
            H = jax.vmap(with_mean_dilatation)(H, jnp.asarray(blocks.weights))
        tissue = jax.tree.map(lambda array: array[self._adjacent], scene.block_tissue_at(theta))
        density = at_points(point_energy(scene, theta), tissue, H)
        return jnp.sum(blocks.weights * density)

    @cached_property
    def _dead(self) -> tuple[float, dict[str, float]]:
        """The work (mN mm) of dead loads on the virtual displacement; and per unit of theta."""
        prescribed, dead = self._virtual[0], dead_force(self._balanced)
        if dead is None:
            return 0.0, {}
        per_unit = {
            name: float(np.vdot(force, prescribed)) for name, force in dead.per_unit.items()
        }
        return float(np.vdot(dead.constant, prescribed)), per_unit

    def _dead_work(self, values: Values) -> jax.Array:
        constant, per_unit = self._dead
        return sum((values[name] * work for name, work in per_unit.items()), jnp.asarray(constant))

    def _local[T: (LocalTerm, LocalForce)](self, parts: Sequence[T]) -> list[T]:
        """Return ``parts`` with nodes numbered as in ``nodes``."""
        return [replace(part, nodes=self._renumbered[part.nodes]) for part in parts]


def _contributions_at[T: (LocalTerm, LocalForce)](
    parts: Sequence[T], at_support: np.ndarray
) -> list[T]:
    """Return the contributions of ``parts`` that have a node that ``moves`` (n,)."""
    contributions: list[T] = []
    for part in parts:
        rows = np.flatnonzero(at_support[part.nodes].any(axis=1))
        if len(rows):
            data = jax.tree.map(lambda array: array[rows], part.data)  # noqa: B023 - used at once
            contributions.append(replace(part, nodes=part.nodes[rows], data=data))
    return contributions
