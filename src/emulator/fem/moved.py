r"""A scene on the mesh x + w: its stress-free shape, where the scene's mesh x is loaded.

With :math:`f = I + \partial w/\partial x` the shape functions have the gradients
:math:`f^{-T} \nabla_x N` there and the quadrature points the weights :math:`\det f\, \omega`;
directions are carried back as material lines (:func:`emulator.fem.loaded_point.carried_back`).
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.energy import displacement_gradient
from emulator.fem.loaded_point import carried_back
from emulator.fem.system import System
from emulator.geometry.discretisation import Blocks
from emulator.mechanics.kinematics import cofactor, determinant
from emulator.scenes.regions import Tissue
from emulator.scenes.scene import Scene


def tissue_at_rest(scene: Scene, w: jax.Array, theta: jax.Array) -> Tissue:
    """Material data (m, q, ...) on the mesh x + w, directions carried back."""
    tissue = scene.tissue_at(theta)
    if tissue.directions is None:
        return tissue
    h = displacement_gradient(scene, w)
    found = jax.vmap(jax.vmap(carried_back))(h, jnp.asarray(tissue.directions))
    return tissue._replace(directions=found)


def at_rest(scene: Scene, w: jax.Array) -> Scene:
    """``scene`` on the mesh x + w, for numbers: sets, law, loads, supports and theta stay.

    Raises
    ------
    InputError
        An element is folded or inverted there, or theta turns the fibres.
    """
    if scene.angles:
        raise InputError(
            f"scene '{scene.name}': theta turns its fibres, so the unloaded body is no scene of "
            "its own; give their angles as numbers"
        )
    directions = tissue_at_rest(scene, w, scene.centre).directions
    fibres = sheets = None
    if directions is not None:
        made = np.asarray(directions)
        fibres, sheets = (made, None) if made.ndim == 3 else (made[:, :, 0], made[:, :, 1])
    mesh = replace(scene.mesh, nodes=scene.mesh.nodes + np.asarray(w))
    # No rule made these directions, and no name says how the mesh was made.
    return replace(scene, mesh=mesh, fibres=fibres, sheets=sheets, fibre_rule=None, origin={})


def moved(scene: Scene, w: jax.Array, theta: jax.Array) -> Scene:
    """:func:`at_rest` for ``w`` (n, 3) and ``theta`` (p,) that may be traced.

    Fibres are those of ``theta``, and turn no more.

    It lives as long as the function that makes it. Nothing is checked.
    """
    grid, tissue = scene.discretisation, tissue_at_rest(scene, w, theta)
    directions = tissue.directions
    fibres = directions if directions is None or directions.ndim == 3 else directions[:, :, 0]
    mesh = copy.copy(scene.mesh)
    object.__setattr__(mesh, "nodes", scene.mesh.nodes + w)
    h = displacement_gradient(scene, w)
    gradients, weights = _at(grid, h)
    there = replace(grid, mesh=mesh, gradients=gradients, weights=weights)
    blocks: Blocks = there
    if scene.dilatation == "patch":
        gradients, weights = _at(scene.blocks, scene.blocks.gather(h))
        blocks = replace(scene.blocks, gradients=gradients, weights=weights)
    view = copy.copy(scene)
    for name, value in (
        ("mesh", mesh),
        ("discretisation", there),
        ("blocks", blocks),
        ("fibres", fibres),
        ("angles", ()),
        ("_tissue", tissue),
        ("_block_tissue", jax.tree.map(blocks.gather, tissue)),
    ):
        object.__setattr__(view, name, value)
    return view


def moved_system(system: System, w: jax.Array, theta: jax.Array) -> System:
    """The equations of ``system``'s scene on the mesh x + w, for arrays that may be traced."""
    there = System(moved(system.scene, w, theta), system.factorisation)
    # What is made of the moved mesh is made here, lest a part of a program keep what is its own.
    _ = there.springs, there.terms, there.forces, there.dead
    return there


def _at(blocks: Blocks, h: jax.Array) -> tuple[Any, Any]:
    """Gradients (b, q, a, 3) and weights (b, q) at x + w, ``h`` (b, q, 3, 3); traced arrays."""
    f = h + jnp.eye(3, dtype=h.dtype)
    det = jax.vmap(jax.vmap(determinant))(f)
    inverse_transposed = jax.vmap(jax.vmap(cofactor))(f) / det[..., None, None]
    gradients = jnp.einsum("bqij,bqaj->bqai", inverse_transposed, blocks.gradients)
    return gradients, blocks.weights * det
