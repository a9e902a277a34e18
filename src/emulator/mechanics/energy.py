r"""Total potential energy of a scene, built of only the terms the scene has.

.. math::
    \Pi(u, \theta) = \int_\Omega W(\nabla u; \theta)\, dX - \sum_\text{loads} \text{work}

in mN mm (= micro J; kPa mm3), Dalton et al. (2023), Eq. 20. The displacement ``u`` is the full
nodal field, (n, 3) in mm, supports included.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from emulator.mechanics.barriers import Barriers
from emulator.mechanics.kinematics import Strain, determinant

if TYPE_CHECKING:  # a scene is made of mechanics, so mechanics only names its type
    from emulator.scenes.scene import Scene

Energy = Callable[[jax.Array, jax.Array], jax.Array]


def displacement_gradient(scene: Scene, u: jax.Array) -> jax.Array:
    """``H = du/dX`` at every quadrature point, (m, q, 3, 3), from ``u`` (n, 3) in mm."""
    local = u[scene.discretisation.connectivity]
    return jnp.einsum("mai,mqaj->mqij", local, scene.discretisation.gradients)


def volume_ratio(scene: Scene, u: jax.Array) -> jax.Array:
    """``J = det F`` at every quadrature point, (m, q); not above 0 means an inverted element."""
    H = displacement_gradient(scene, u)
    return jax.vmap(jax.vmap(determinant))(H + jnp.eye(3, dtype=H.dtype))


def point_energy(scene: Scene, theta: jax.Array, barriers: Barriers | None = None) -> Callable:
    """``W(H)`` in kPa for one displacement gradient (3, 3) at parameters ``theta`` (p,)."""
    values = scene.resolve(theta)
    arguments = [values[name] for name in scene.law.parameters]
    return lambda H: scene.law.energy(Strain(H, barriers), *arguments)


def strain_energy(scene: Scene, barriers: Barriers | None = None) -> Energy:
    """``(u, theta) -> int W dX`` in mN mm."""

    def energy(u: jax.Array, theta: jax.Array) -> jax.Array:
        density = jax.vmap(jax.vmap(point_energy(scene, theta, barriers)))
        return jnp.sum(scene.discretisation.weights * density(displacement_gradient(scene, u)))

    return energy


def nodal_dead_force(scene: Scene) -> np.ndarray | None:
    """Consistent nodal forces of the dead loads, (n, 3) in mN; ``None`` when there are none."""
    if not scene.loads:
        return None
    grid = scene.discretisation
    volume = np.einsum("mq,qa->ma", grid.weights, grid.values)
    nodal_volume = np.bincount(
        grid.connectivity.ravel(), volume.ravel(), minlength=len(scene.mesh.nodes)
    )
    return nodal_volume[:, None] * sum(load.body_force for load in scene.loads)


def potential_energy(scene: Scene, barriers: Barriers | None = None) -> Energy:
    """Total potential energy ``Pi(u, theta)`` in mN mm.

    Parameters
    ----------
    scene : what is simulated.
    barriers : limits on the invariants for training; ``None`` gives the exact energy, which is
        NaN wherever an element is inverted.
    """
    internal = strain_energy(scene, barriers)
    force = nodal_dead_force(scene)
    if force is None:
        return internal
    return lambda u, theta: internal(u, theta) - jnp.vdot(force, u)
