r"""Reactions: the forces of the supports on a body, and the resultant of one support.

Bulk forces :math:`f_\text{bulk} = \partial \Pi_\text{elastic} / \partial u` are internal and add up
to zero. At equilibrium loads and supports balance them at every node,

.. math:: f_\text{bulk} = f_\text{ext} + R , \qquad
          R = f_\text{bulk} - f_\text{ext} \;\text{(prescribed)}, \quad
          R = -\frac{\partial \Pi_s}{\partial u} \;\text{(springs)},

so the sum of all R is minus the resultant of the loads.

The resultant of one support along the unit vector d follows from the virtual displacement
:math:`\varphi` that moves the support's nodes by d and no others,

.. math:: R \cdot d = \Pi_\text{elastic}'(u)[\varphi] + \Pi_s'(u)[\varphi]
          - f_\text{ext} \cdot \varphi \;\text{(prescribed)}, \qquad
          R \cdot d = -\Pi_s'(u)[\varphi] \;\text{(springs)},

in mN. Springs of another support at prescribed nodes are not part of it. Only elements (or patches
of them), springs and loads at these nodes enter (:class:`SupportForce`). It is the derivative of
the least potential energy by the support's own displacement along d, because the energy at
equilibrium does not change with the free displacements (envelope theorem).
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
    DeadForce,
    block_energies,
    dead_force,
    force_on_body,
    local_forces,
    local_terms,
    spring_terms,
    strain_energy,
)
from emulator.geometry.mesh import Mesh
from emulator.scenes.part import LocalForce, LocalTerm
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
    at_prescribed = bulk - system.external_force(u, theta)
    return jnp.where(system.scene.held, at_prescribed, system.spring_force(u, theta))


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
    springs : whether springs at displacements that are free count.

    Raises
    ------
    InputError
        No support of that name, one that does not act along the direction, or a direction of no
        length.
    """

    scene: Scene
    name: str
    direction: tuple[float, float, float]
    springs: bool = True

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
        if not any(self.acts_by):
            raise InputError(
                f"force of support '{self.name}': nothing is held along {self.direction} there"
            )

    @property
    def acts_by(self) -> tuple[bool, bool]:
        """Say whether the support acts by prescribed displacements, and whether by springs."""
        prescribed, sprung = self._virtual
        return bool(prescribed.any()), bool(sprung.any())

    @property
    def support_nodes(self) -> np.ndarray:
        """The nodes (k,) of the support."""
        return nodes_of(self.scene.mesh, self.name)

    @cached_property
    def _balanced(self) -> Scene:
        return balanced(self.scene)

    @cached_property
    def _virtual(self) -> tuple[np.ndarray, np.ndarray]:
        """The virtual displacement (n, 3) at prescribed displacements, and at springs."""
        held, virtual = self.scene.held, np.zeros(self.scene.held.shape)
        virtual[self.support_nodes] = self.direction
        sprung = np.zeros((len(virtual), 1), dtype=bool)
        for spring in spring_terms(self.scene) if self.springs else ():
            sprung[spring.nodes] = True
        return np.where(held, virtual, 0.0), np.where(sprung & ~held, virtual, 0.0)

    @cached_property
    def _adjacent(self) -> np.ndarray:
        """The blocks that have a prescribed node of the support."""
        at_support = self._virtual[0].any(axis=1)
        return np.flatnonzero(at_support[self._balanced.blocks.connectivity].any(axis=1))

    @cached_property
    def _parts(self) -> tuple[list[LocalTerm | LocalForce], list[LocalTerm]]:
        """Loads that follow the deformation, and springs, at the support's nodes."""
        scene, (prescribed, sprung) = self._balanced, self._virtual
        loads: list[LocalTerm | LocalForce] = [*local_terms(scene), *local_forces(scene)]
        springs = _contributions_at(spring_terms(scene), prescribed + sprung)
        return _contributions_at(loads, prescribed), springs

    @cached_property
    def nodes(self) -> np.ndarray:
        """The nodes (k,) whose displacement the force depends on."""
        parts = [part.nodes.ravel() for group in self._parts for part in group]
        blocks = self._balanced.blocks.connectivity[self._adjacent].ravel()
        return np.unique(np.concatenate([blocks, *parts]))

    @cached_property
    def _dead(self) -> DeadForce:
        """The dead loads at :attr:`nodes`, (k, 3) in mN."""
        dead = dead_force(self._balanced)
        per_unit = {name: force[self.nodes] for name, force in dead.per_unit.items()}
        return DeadForce(dead.constant[self.nodes], per_unit)

    def __call__(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the force (...) in mN from ``u`` (..., k, 3) mm of ``nodes`` and ``theta``."""
        return jnp.vectorize(self._force, signature="(k,i),(p)->()")(u, theta)

    def _force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        scene, adjacent = self._balanced, self._adjacent
        values, number = scene.resolve(theta), np.full(len(scene.mesh.nodes), -1)
        number[self.nodes] = np.arange(len(self.nodes))
        prescribed, sprung = (jnp.asarray(virtual[self.nodes]) for virtual in self._virtual)
        connectivity = number[scene.blocks.connectivity[adjacent]]

        def strain_energy_at_support(v: jax.Array) -> jax.Array:
            H = jnp.einsum("bai,bqaj->bqij", v[connectivity], scene.blocks.gradients[adjacent])
            return jnp.sum(block_energies(scene, theta, H, adjacent))

        def force_of(parts: Sequence[LocalTerm | LocalForce]) -> jax.Array:
            local = (replace(part, nodes=number[part.nodes]) for part in parts)
            return force_on_body(local, u, values) + jnp.zeros_like(u)

        loads, springs = self._parts
        bulk = jnp.zeros(())
        if self.acts_by[0]:
            bulk = jax.jvp(strain_energy_at_support, (u,), (prescribed,))[1]
        others = force_of(loads) + self._dead.total(values) + (by_springs := force_of(springs))
        return bulk - jnp.vdot(others, prescribed) + jnp.vdot(by_springs, sprung)


def support_forces(scene: Scene) -> dict[str, SupportForce]:
    """Return the force of each support along each axis that it holds, by ``SUPPORT:AXIS``."""
    return {
        f"{held.where}:{'xyz'[k]}": SupportForce(scene, held.where, tuple(np.eye(3)[k].tolist()))
        for support in scene.supports
        if (held := support.held(scene.mesh)) is not None
        for k in held.axes
    }


def _contributions_at[T: (LocalTerm, LocalForce, LocalTerm | LocalForce)](
    parts: Sequence[T], virtual: np.ndarray
) -> list[T]:
    """Return the contributions of ``parts`` that have a node that ``virtual`` (n, 3) moves."""
    contributions: list[T] = []
    for part in parts:
        rows = np.flatnonzero(virtual.any(axis=1)[part.nodes].any(axis=1))
        if len(rows):
            data = jax.tree.map(lambda array: array[rows], part.data)  # noqa: B023 - used at once
            contributions.append(replace(part, nodes=part.nodes[rows], data=data))
    return contributions
