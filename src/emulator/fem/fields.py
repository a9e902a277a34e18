r"""Stress, strain and fibre stretch of each element, for pictures and tables.

.. math::
    P = \partial W / \partial F + P_a, \quad \sigma = P F^T / J, \quad E = (F^T F - I)/2

with :math:`P_a` the stress that loads add, of muscle or as the tissue lies.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.compiled import compiled
from emulator.fem.energy import at_points, energy_of_gradient
from emulator.geometry.fibres import unit
from emulator.mechanics.kinematics import determinant
from emulator.scenes.tissue import stiffness_of

if TYPE_CHECKING:
    from emulator.scenes.scene import Scene


def displacement_gradient(scene: Scene, u: jax.Array) -> jax.Array:
    """Return ``du/dX`` (m, q, 3, 3) of ``u`` (n, 3) mm; deprecated, use ``Scene.gradients``."""
    text = "em.fem.displacement_gradient goes in 0.11; write scene.gradients(u)"
    warnings.warn(text, DeprecationWarning, stacklevel=2)
    return scene.gradients(u)


def element_fields(scene: Scene, u: jax.Array, theta: jax.Array) -> dict[str, np.ndarray]:
    """Return means over each element, weighted by reference volume.

    Parameters
    ----------
    scene : the scene that was simulated.
    u : the displacement, (n, 3) mm.
    theta : the parameters, (p,).

    Returns
    -------
    ``J`` (m,), ``cauchy_stress`` (m, 3, 3) in kPa, ``green_lagrange`` (m, 3, 3); with fibres also
    ``fibres`` and ``deformed_fibres`` (m, 3), both of unit length, and ``fibre_stretch`` (m,); with
    regions or modes of stiffness also ``regions`` (m,) and the factor ``stiffness`` (m,).
    """
    means = element_means(scene)(jnp.asarray(u), jnp.asarray(theta))
    fields = {name: np.asarray(values) for name, values in means.items()}
    for name in {"fibres", "deformed_fibres"} & fields.keys():
        fields[name] = unit(fields[name])
    if scene.regions is not None:
        fields["regions"] = scene.regions
    stiffness = stiffness_of(scene.regions, scene.stiffness_modes, scene.resolve(theta))
    if stiffness is not None:
        fields["stiffness"] = np.asarray(stiffness)
    return fields


def element_means(scene: Scene) -> Callable[[jax.Array, jax.Array], dict[str, jax.Array]]:
    """Return a program for the means of :func:`element_fields` at many displacements and theta.

    The means of directions are not of unit length.
    """
    return compiled(partial(_means, scene))


def _means(scene: Scene, u: jax.Array, theta: jax.Array) -> dict[str, jax.Array]:
    """Return the means at one displacement and theta."""
    H = scene.gradients(u)
    F = H + jnp.eye(3, dtype=H.dtype)
    J = at_points(determinant, F)
    P = _first_piola(scene, H, theta)
    values = scene.resolve(theta)
    fibres = None if scene.fibres is None else scene.fibres_at(theta)
    load_stresses = (load.first_piola(F, scene.mesh, fibres, values) for load in scene.loads)
    P = sum((stress for stress in load_stresses if stress is not None), P)
    # Round-off leaves sigma slightly asymmetric; eigenvalue routines need it symmetric.
    sigma = _symmetric(P @ jnp.swapaxes(F, -1, -2)) / J[..., None, None]
    fields = {
        "J": J,
        "cauchy_stress": sigma,
        "green_lagrange": _symmetric(H + 0.5 * jnp.swapaxes(H, -1, -2) @ H),
    }
    if fibres is not None:
        along = jnp.einsum("mqij,mqj->mqi", F, fibres)
        fields |= {"fibres": fibres, "deformed_fibres": along}
        fields["fibre_stretch"] = jnp.linalg.norm(along, axis=-1)
    weights = scene.discretisation.weights
    weights = weights / weights.sum(axis=1, keepdims=True)
    return {name: jnp.einsum("mq,mq...->m...", weights, field) for name, field in fields.items()}


def _first_piola(scene: Scene, H: jax.Array, theta: jax.Array) -> jax.Array:
    """Return the first Piola-Kirchhoff stress (m, q, 3, 3) in kPa of the strain energy."""
    slope = jax.grad(energy_of_gradient, argnums=1)(scene, H, theta)
    return slope / scene.discretisation.weights[..., None, None]


def _symmetric(A: jax.Array) -> jax.Array:
    return 0.5 * (A + jnp.swapaxes(A, -1, -2))
