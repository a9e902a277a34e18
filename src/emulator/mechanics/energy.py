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
from emulator.mechanics.loads import Gravity
from emulator.mechanics.pressure import LocalTerm

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
    """``W(H, fibre)`` in kPa for one displacement gradient (3, 3) at parameters ``theta`` (p,)."""
    values = scene.resolve(theta)
    arguments = [values[name] for name in scene.law.parameters]
    return lambda H, fibre=None: scene.law.energy(Strain(H, barriers, fibre), *arguments)


def at_points(scene: Scene, function: Callable, H: jax.Array) -> jax.Array:
    """``function(H)`` at every point of ``H`` (m, q, 3, 3), with the fibre if the scene has one."""
    if scene.fibres is None:
        return jax.vmap(jax.vmap(function))(H)
    return jax.vmap(jax.vmap(function, (0, None)))(H, jnp.asarray(scene.fibres))


def strain_energy(scene: Scene, barriers: Barriers | None = None) -> Energy:
    """``(u, theta) -> int W dX`` in mN mm."""

    def energy(u: jax.Array, theta: jax.Array) -> jax.Array:
        density = at_points(
            scene, point_energy(scene, theta, barriers), displacement_gradient(scene, u)
        )
        return jnp.sum(scene.discretisation.weights * density)

    return energy


def local_terms(scene: Scene) -> list[LocalTerm]:
    """Potentials of the loads that follow the deformation."""
    return [load.term(scene) for load in scene.loads if not isinstance(load, Gravity)]


def nodal_dead_force(scene: Scene) -> np.ndarray | None:
    """Consistent nodal forces of the dead loads, (n, 3) in mN; ``None`` when there are none."""
    dead = [load for load in scene.loads if isinstance(load, Gravity)]
    if not dead:
        return None
    grid = scene.discretisation
    volume = np.einsum("mq,qa->ma", grid.weights, grid.values)
    nodal_volume = np.bincount(
        grid.connectivity.ravel(), volume.ravel(), minlength=len(scene.mesh.nodes)
    )
    return nodal_volume[:, None] * sum(load.body_force for load in dead)


def potential_energy(scene: Scene, barriers: Barriers | None = None) -> Energy:
    """Total potential energy ``Pi(u, theta)`` in mN mm.

    Parameters
    ----------
    scene : what is simulated.
    barriers : limits on the invariants for training; ``None`` gives the exact energy, which is
        NaN wherever an element is inverted.
    """
    internal = strain_energy(scene, barriers)
    force, terms = nodal_dead_force(scene), local_terms(scene)

    def energy(u: jax.Array, theta: jax.Array) -> jax.Array:
        total = internal(u, theta)
        if force is not None:
            total = total - jnp.vdot(force, u)
        if terms:
            values = scene.resolve(theta)
            total = total + sum(term.total(u, values) for term in terms)
        return total

    return energy
