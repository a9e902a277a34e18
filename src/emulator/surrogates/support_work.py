r"""The force of a support that moves, from the work of the whole body in place of stresses there.

At equilibrium u the force along d on a support is the work of the internal forces on *any* virtual
displacement :math:`\varphi` that is d at the support and zero at the others
(:mod:`emulator.fem.reactions`),

.. math:: R \cdot d = \Pi'(u)[\varphi] .

Of a displacement with a small error e it is wrong by :math:`e \cdot K \varphi`, with the tangent K.
A :math:`\varphi` that moves the support alone is the worst choice: its error is that of the
stresses at the support's edge, where they are singular. The best is the rate at which the body
itself follows the support, :math:`\varphi = \partial u/\partial a` with a the amount of the motion:
:math:`K \varphi` is zero where free, and an emulator, whose own rate is wrong by :math:`e'`, errs
by :math:`e \cdot K e'`, of second order. Then :math:`R \cdot d` is the derivative of the least
potential energy by the motion. With c the support's displacement for a unit of a,

.. math:: \varphi = \alpha\, \frac{\partial u}{\partial a} + (d - \alpha c)\;\text{at the support},
          \qquad \alpha = \frac{d \cdot c}{c \cdot c} .

A body that lies in equilibrium under a tension has a force on the support at rest; the work is that
of what the motion adds to it.

The work is a sum over quadrature points and springs. A few of them with weights of 0 or more give
it, too (Farhat et al. 2014, energy-conserving sampling and weighting): non-negative least squares,
over a few theta, finds at most as many as there are theta.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.campaign.designs import sobol
from emulator.fem.energy import (
    block_energies,
    force_on_body,
    local_terms,
    one_of_each,
    spring_terms,
)
from emulator.fem.reactions import SupportForce
from emulator.scenes.scene import Scene
from emulator.surrogates.protocol import ForwardMap

_PER_PARAMETER = 8  # theta by which points are weighed, for each parameter
_FEWEST = 48  # theta
_AT_ONCE = 8  # theta in one batch
_ROUND_OFF = 1e-9  # of the largest force at a node
_ALONG = 0.7  # least cosine between the motion and the force's direction


def amount_of(force: SupportForce) -> str | None:
    """Return the parameter whose change moves the support along the force, and no other support.

    None where there is none, or where the body is not in equilibrium as it lies.
    """
    scene = force.scene
    at_support = np.zeros(len(scene.mesh.nodes), dtype=bool)
    at_support[force.support_nodes] = True
    best, most = None, _ALONG
    for name in scene.parameter_names:
        per_unit = scene.prescribed.per_unit.get(name)
        if per_unit is None or per_unit[~at_support].any():
            continue
        c = per_unit[at_support].mean(axis=0)
        if (along := abs(c @ np.asarray(force.direction)) / np.linalg.norm(c)) > most:
            best, most = name, along
    return best if best is not None and _rests(scene) else None


def _rests(scene: Scene) -> bool:
    """Return whether the mesh is an equilibrium of the body without load."""
    if any(load.energy_density is None for load in scene.loads):
        return False
    with jax.ensure_compile_time_eval():
        rest, values = jnp.zeros(scene.held.shape), scene.resolve(scene.centre)
        force = np.asarray(force_on_body(local_terms(scene), rest, values) + rest)
    free = np.abs(force[~scene.held])
    return bool(free.max(initial=0.0) <= _ROUND_OFF * np.abs(force).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class SupportWork:
    """The force in mN of a support as a function of theta, by the work of an emulated displacement.

    forward : the map from theta to the displacement of all nodes, which is nearly in equilibrium.
    force : the force of the support.
    amount : the parameter that moves the support, of :func:`amount_of`.
    """

    forward: ForwardMap
    force: SupportForce
    amount: str

    @property
    def scene(self) -> Scene:
        """The scene of the support."""
        return self.force.scene

    @cached_property
    def _share(self) -> tuple[float, np.ndarray]:
        """The factor alpha, and the remaining virtual displacement at the support, (n, 3)."""
        nodes, d = self.force.support_nodes, np.asarray(self.force.direction)
        per_unit = self.scene.prescribed.per_unit[self.amount]
        c = per_unit[nodes].mean(axis=0)
        alpha, left = float(d @ c / (c @ c)), np.zeros(per_unit.shape)
        left[nodes] = np.where(self.scene.held[nodes], d - alpha * per_unit[nodes], 0.0)
        return alpha, left

    def _works(self, cells: _Cells, theta: jax.Array) -> jax.Array:
        """Return the work (c,) in mN of each of ``cells`` on the virtual displacement."""
        alpha, left = self._share
        forward = cells.forward
        along = jnp.zeros(len(theta)).at[self.scene.parameter_names.index(self.amount)].set(1.0)
        u, rate = jax.jvp(forward, (theta,), (along,))
        virtual = alpha * rate + left[forward.nodes]
        return jax.jvp(lambda v: cells.energies(v, theta), (u,), (virtual,))[1]

    @cached_property
    def _loaded_at_rest(self) -> bool:
        """Whether the support carries a force as the body lies."""
        with jax.ensure_compile_time_eval():
            rest = jnp.zeros((len(self.force.nodes), 3))
            return bool(np.any(np.asarray(self.force(rest, self.scene.centre)) != 0.0))

    @cached_property
    def _weighed(self) -> tuple[_Cells, np.ndarray]:
        """A small subset of cells, and their weights (c,), that integrates the support's work."""
        from scipy.optimize import nnls

        count = max(_FEWEST, _PER_PARAMETER * len(self.scene.parameters))
        every = _Cells.of(self.scene, self.forward)
        # What is kept must not be traced, wherever this is asked for first.
        with jax.ensure_compile_time_eval():
            thetas = sobol(self.scene, count, seed=0)
            program = jax.jit(
                lambda t: jax.lax.map(lambda x: self._works(every, x), t, batch_size=_AT_ONCE)
            )
            works = np.asarray(program(thetas))
        works = works[np.isfinite(works).all(axis=1)]
        size = np.abs(works).sum(axis=1, keepdims=True)
        works = works[size[:, 0] > 0.0] / size[size[:, 0] > 0.0]
        if not len(works):
            return every, np.ones(works.shape[1])
        weights, _ = nnls(works, works.sum(axis=1), maxiter=20 * works.shape[1])
        chosen = np.flatnonzero(weights)
        return every.only(chosen), weights[chosen]

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the force () in mN at ``theta`` (p,)."""
        cells, weights = self._weighed
        force = jnp.vdot(weights, self._works(cells, theta))
        if self._loaded_at_rest:
            force += self.force(jnp.zeros((len(self.force.nodes), 3)), theta)
        return force


@dataclass(frozen=True, eq=False)
class _Cells:
    """Quadrature points and groups of springs of a scene, as few as asked for.

    forward : the map of the displacement of the nodes that they depend on.
    points : the numbers (k,) of the points, block after block; None for all.
    springs : the numbers (g,) of the springs' groups, by term.
    """

    scene: Scene
    forward: ForwardMap
    points: np.ndarray | None
    springs: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, scene: Scene, forward: ForwardMap) -> _Cells:
        """Return all quadrature points and springs of a scene."""
        springs = tuple(np.arange(len(term.nodes)) for term in spring_terms(scene))
        return cls(scene, forward, None, springs)

    def only(self, chosen: np.ndarray) -> _Cells:
        """Return the cells with these numbers, ascending, with the forward map of their nodes."""
        ends = np.cumsum([self.scene.blocks.weights.size, *(len(rows) for rows in self.springs)])
        parts = np.split(chosen, np.searchsorted(chosen, ends))[:-1]
        points, *springs = (part - start for part, start in zip(parts, [0, *ends], strict=False))
        used = points // self.scene.blocks.weights.shape[1]
        nodes = [self.scene.blocks.connectivity[used].ravel()]
        for term, rows in zip(spring_terms(self.scene), springs, strict=True):
            nodes.append(term.nodes[rows].ravel())
        forward = self.forward.at(np.unique(np.concatenate(nodes)))
        return _Cells(self.scene, forward, points, tuple(springs))

    def energies(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the energy (c,) in mN mm of each at ``u`` (n, 3) mm of the map's nodes."""
        scene, number = self.scene, np.full(len(self.scene.mesh.nodes), -1)
        number[self.forward.nodes] = np.arange(len(self.forward.nodes))
        blocks, values = scene.blocks, scene.resolve(theta)
        rows, points = np.arange(len(blocks.weights)), None
        if self.points is not None:
            rows, points = np.divmod(self.points, blocks.weights.shape[1])
        weights, local = blocks.weights[rows], u[number[blocks.connectivity[rows]]]
        H = jnp.einsum("bai,bqaj->bqij", local, blocks.gradients[rows])
        elastic = block_energies(scene, theta, H, rows, points)
        if points is not None:
            weights, H = one_of_each(points, weights), one_of_each(points, H)
        for load in scene.loads:
            if load.energy_density is not None:
                elastic += weights * load.energy_density(H, values)
        energies = [elastic.ravel()]
        for term, groups in zip(spring_terms(scene), self.springs, strict=True):
            data = jax.tree.map(lambda array: array[groups], term.data)  # noqa: B023 - used at once
            local_term = replace(term, nodes=number[term.nodes[groups]], data=data)
            energies.append(local_term.energies(u, values))
        return jnp.concatenate(energies)
