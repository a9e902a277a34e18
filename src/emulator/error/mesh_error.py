r"""The error of the mesh: how far a solution is from the same body's on a finer mesh.

An equilibrium :math:`u_h` on a mesh of size h, and one on the next finer mesh
(:mod:`emulator.scenes.finer`), differ by

.. math:: u_h - u_{h/2} = (u_h - u)\,(1 - 2^{-k}), \qquad |u_h - u| \sim h^k ,

most of the error: seven eighths at :math:`k = 3`, as quadratic elements have on smooth solutions,
a half at :math:`k = 1`, as at the edge of a clamp; from linear to quadratic elements nearly all of
it. So the difference has an effectivity of one half to one. It is a solve, not an estimate of one:
FEM's iteration starts at the prolonged solution, moved by what the last one needed, and two or
three steps end it. Locked elements are far away and are solved for all the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.fem.options import NewtonOptions
from emulator.fem.simulator import Simulator
from emulator.scenes.finer import Finer, finer
from emulator.scenes.scene import Scene

LARGEST = 60_000
"""Nodes of a finer mesh that is still solved on; beyond, a factorisation takes minutes and the
memory of a workstation."""

Quantity = Callable[[jax.Array, jax.Array], jax.Array]


class MeshErrorEstimate(NamedTuple):
    """The mesh's error at one theta.

    theta : (p,). coarse : (n, 3) mm, the equilibrium on the mesh. fine : (f, 3) mm, on the finer
    one, whose first n nodes are the mesh's.
    """

    theta: jax.Array
    coarse: jax.Array
    fine: jax.Array

    @property
    def field(self) -> jax.Array:
        """The mesh's displacement less the finer one's at the mesh's nodes, (n, 3) mm."""
        return self.coarse - self.fine[: len(self.coarse)]

    @property
    def err_u(self) -> jax.Array:
        """Length of :attr:`field` at each node, (n,) mm."""
        return jnp.linalg.norm(self.field, axis=1)

    def of(self, on_mesh: Quantity, on_finer: Quantity) -> jax.Array:
        """Error of a quantity ``q(u, theta)`` that is defined on both meshes, in its unit."""
        return on_mesh(self.coarse, self.theta) - on_finer(self.fine, self.theta)


@dataclass(frozen=True, eq=False)
class MeshError:
    """Errors of a simulator's mesh; made by :func:`mesh_error`."""

    simulator: Simulator
    finer: Finer
    options: NewtonOptions = field(default_factory=NewtonOptions)

    @cached_property
    def fine(self) -> Simulator:
        """The simulator on the finer mesh."""
        return Simulator(self.finer.scene, self.options, self.simulator.factorisation)

    def __call__(self, theta: jax.Array) -> MeshErrorEstimate:
        """The error at ``theta`` (p,); :class:`SolverError` where either mesh has no solution."""
        return next(self.many([theta]))

    def many(
        self, thetas: Iterable[jax.Array], starts: Iterable[jax.Array | None] | None = None
    ) -> Iterator[MeshErrorEstimate]:
        """The error at each theta, each solve started from what the last one found.

        starts : (n, 3) mm, where the coarse solves begin; from rest by default.
        """
        step = np.zeros((len(self.finer.scene.mesh.nodes), 3))
        given = iter(starts) if starts is not None else None
        for theta in thetas:
            begin = None if given is None else next(given)
            coarse = self.simulator.solve(theta, begin).require_converged("the mesh's error")
            carried = self.finer.refinement.carry(np.asarray(coarse.displacement))
            solution = self.fine.solve(theta, jnp.asarray(carried + step))
            fine = solution.require_converged("the mesh's error, on the finer mesh").displacement
            step = np.asarray(fine) - carried
            yield MeshErrorEstimate(jnp.asarray(theta), coarse.displacement, fine)


def mesh_error(simulator: Simulator | Scene, *, most: int = LARGEST) -> MeshError:
    """Errors of the mesh of ``simulator``, or of FEM with its defaults for a scene.

    Parameters
    ----------
    most : nodes of a finer mesh that is still solved on.

    Raises
    ------
    InputError
        A finer mesh of more nodes, or a load that it cannot have.
    """
    given = simulator if isinstance(simulator, Simulator) else Simulator(simulator)
    found = finer(given.scene)
    if (count := len(found.scene.mesh.nodes)) > most:
        raise InputError(
            f"mesh error: the mesh finer than that of '{given.scene.name}' has {count} nodes, more "
            f"than {most}; ask for more with 'most', or check a coarser mesh of the same body"
        )
    return MeshError(given, found, given.options)
