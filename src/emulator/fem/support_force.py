r"""The force with which one support holds a body, from displacements near it alone.

With the virtual displacement :math:`\varphi` that moves the support's nodes by the unit vector d
and no others, the resultant along d is

.. math:: R \cdot d = \Pi_\text{elastic}'(u)[\varphi] - f_\text{ext} \cdot \varphi
          \;\text{(held)}, \qquad
          R \cdot d = -\Pi_s'(u)[\varphi] \;\text{(springs)},

in mN, which only elements (or patches of them), springs and loads at these nodes enter. It is the
derivative of the least potential energy by the support's own displacement along d, because the
energy at equilibrium does not change with the free displacements (envelope theorem).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.energy import (
    at_points,
    dead_force,
    local_forces,
    local_terms,
    point_energy,
    spring_terms,
    with_mean_dilatation,
)
from emulator.fem.reactions import balanced, nodes_of, supported_sets
from emulator.geometry.discretisation import Blocks
from emulator.scenes.local_terms import LocalForce, LocalTerm, Values
from emulator.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class SupportForce:
    """Force in mN of the support on the nodes or facets ``name``, on the body, along ``direction``.

    Parameters
    ----------
    scene : with a support there, held or elastic.
    name : of its node set or facet set.
    direction : (3,), made unit length.

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
        held, sprung = self._virtual
        if not held.any() and not sprung.any():
            raise InputError(
                f"force of support '{self.name}': nothing is held along {self.direction} there"
            )

    @cached_property
    def _loaded(self) -> Scene:
        return balanced(self.scene)

    @cached_property
    def _virtual(self) -> tuple[np.ndarray, np.ndarray]:
        """Virtual displacement (n, 3) of what is held there, and of what is on springs."""
        at = nodes_of(self.scene.mesh, self.name)
        moved = np.zeros(self.scene.held.shape)
        moved[at] = self.direction
        sprung = np.zeros(len(moved), dtype=bool)
        for spring in spring_terms(self.scene):
            sprung[spring.nodes] = True
        held = self.scene.held
        return np.where(held, moved, 0.0), np.where(sprung[:, None] & ~held, moved, 0.0)

    @cached_property
    def _near(self) -> np.ndarray:
        """Rows of the blocks that have a held node of the support."""
        return np.flatnonzero(
            self._moves(self._virtual[0])[self._loaded.blocks.connectivity].any(1)
        )

    @cached_property
    def _bulk(self) -> Blocks:
        whole = self._loaded.blocks
        connectivity = self._renumbered[whole.connectivity[self._near]]
        return Blocks(connectivity, whole.gradients[self._near], whole.weights[self._near])

    @cached_property
    def _parts(self) -> tuple[list[LocalTerm], list[LocalForce], list[LocalTerm]]:
        """Potentials and forces of the loads at held nodes; potentials of springs at free ones."""
        held, sprung = self._virtual
        scene = self._loaded
        terms = _touching(local_terms(scene), self._moves(held))
        forces = _touching(local_forces(scene), self._moves(held))
        return terms, forces, _touching(spring_terms(scene), self._moves(sprung))

    @staticmethod
    def _moves(virtual: np.ndarray) -> np.ndarray:
        return virtual.any(axis=1)

    @cached_property
    def nodes(self) -> np.ndarray:
        """Nodes (k,) whose displacement it depends on."""
        parts = [part.nodes.ravel() for group in self._parts for part in group]
        return np.unique(
            np.concatenate([self._loaded.blocks.connectivity[self._near].ravel(), *parts])
        )

    @cached_property
    def _renumbered(self) -> np.ndarray:
        position = np.full(len(self.scene.mesh.nodes), -1)
        position[self.nodes] = np.arange(len(self.nodes))
        return position

    def __call__(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """The force (...) in mN from ``u`` (..., k, 3) mm of ``nodes``, at ``theta`` (..., p)."""
        return jnp.vectorize(self._force, signature="(k,i),(p)->()")(u, theta)

    def _force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        held, sprung = (jnp.asarray(virtual[self.nodes]) for virtual in self._virtual)
        values = self._loaded.resolve(theta)
        terms, forces, springs = self._parts

        def holding(v: jax.Array) -> jax.Array:
            loads = sum((t.total(v, values) for t in self._local(terms)), jnp.zeros(()))
            return self._strain_energy(v, theta) + loads

        def pulling(v: jax.Array) -> jax.Array:
            return sum((s.total(v, values) for s in self._local(springs)), jnp.zeros(()))

        force = jax.jvp(holding, (u,), (held,))[1] - jax.jvp(pulling, (u,), (sprung,))[1]
        for follower in self._local(forces):
            force = force - jnp.vdot(follower.total(u, values), held)
        return force - self._dead_work(values)

    def _strain_energy(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Energy () in mN mm of the blocks at the support."""
        blocks, scene = self._bulk, self._loaded
        H = jnp.einsum("bai,bqaj->bqij", u[blocks.connectivity], blocks.gradients)
        if scene.dilatation != "pointwise":
            H = jax.vmap(with_mean_dilatation)(H, jnp.asarray(blocks.weights))
        tissue = jax.tree.map(lambda array: array[self._near], scene.block_tissue_at(theta))
        density = at_points(point_energy(scene, theta), tissue, H)
        return jnp.sum(blocks.weights * density)

    @cached_property
    def _dead(self) -> tuple[float, dict[str, float]]:
        """Work in mN mm of the dead loads on the virtual displacement, and per unit of theta."""
        held, dead = self._virtual[0], dead_force(self._loaded)
        if dead is None:
            return 0.0, {}
        per_unit = {name: float(np.vdot(force, held)) for name, force in dead.per_unit.items()}
        return float(np.vdot(dead.constant, held)), per_unit

    def _dead_work(self, values: Values) -> jax.Array:
        constant, per_unit = self._dead
        return sum((values[name] * work for name, work in per_unit.items()), jnp.asarray(constant))

    def _local[T: (LocalTerm, LocalForce)](self, parts: Sequence[T]) -> list[T]:
        """The same on ``nodes``."""
        return [replace(part, nodes=self._renumbered[part.nodes]) for part in parts]


def _touching[T: (LocalTerm, LocalForce)](parts: Sequence[T], moves: np.ndarray) -> list[T]:
    """The contributions of ``parts`` that have a node that ``moves`` (n,)."""
    found: list[T] = []
    for part in parts:
        rows = np.flatnonzero(moves[part.nodes].any(axis=1))
        if len(rows):
            data = jax.tree.map(lambda array: array[rows], part.data)  # noqa: B023 - used at once
            found.append(replace(part, nodes=part.nodes[rows], data=data))
    return found
