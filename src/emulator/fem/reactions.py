r"""Forces with which the supports hold a body.

Bulk forces :math:`f_\text{bulk} = \partial \Pi_\text{elastic} / \partial u` are internal and add up
to zero. At equilibrium loads and supports balance them at every node,

.. math:: f_\text{bulk} = f_\text{ext} + R , \qquad
          R = f_\text{bulk} - f_\text{ext} \;\text{(held)}, \quad
          R = -\frac{\partial \Pi_s}{\partial u} \;\text{(springs)},

so the sum of all R is minus the resultant of the loads.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.energy import strain_energy
from emulator.fem.loop import compiled
from emulator.fem.system import System
from emulator.geometry.mesh import Mesh
from emulator.scenes.scene import Scene


def balanced(scene: Scene) -> Scene:
    """``scene`` with loads whose forces are right at held nodes, too."""
    return replace(scene, loads=tuple(load.at_held_nodes for load in scene.loads))


@compiled
def reactions(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Force (n, 3) in mN of the supports on the body, springs included; zero where it is free.

    ``u`` (n, 3) mm is the equilibrium at ``theta`` (p,); ``system`` that of :func:`balanced`.
    """
    bulk = jax.grad(strain_energy(system.scene))(u, theta)
    values = system.scene.resolve(theta)
    springs = jax.grad(lambda v: sum((s.total(v, values) for s in system.springs), 0.0))(u)
    held = jnp.asarray(system.scene.held)
    return jnp.where(held, bulk - system.external_force(u, theta), -springs)


def nodes_of(mesh: Mesh, name: str) -> np.ndarray:
    """Nodes (k,) of the node set or facet set ``name``; :class:`InputError` for neither."""
    if name not in mesh.node_sets and name in mesh.facet_sets:
        return np.unique(mesh.facet_set(name))
    return mesh.node_set(name)


def supported_sets(scene: Scene) -> dict[str, np.ndarray]:
    """Nodes (k,) of each support, by the name of its set."""
    found: dict[str, np.ndarray] = {}
    for support in scene.supports:
        held = support.held(scene.mesh)
        if held is not None:
            found[held.where] = held.nodes
        for name in support.facet_sets:
            found[name] = nodes_of(scene.mesh, name)
    return found
