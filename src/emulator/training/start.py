"""Starting a training from the network of another emulator.

Encoders, messages and decoders are shared by all nodes, so their weights fit any mesh (Dalton et
al. 2023, Appendix E). Series, scale and graph belong to one scene and are never carried over; the
ranges of the parameters may differ, because the network sees positions in the box.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from emulator.errors import InputError
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import Emulator
from emulator.surrogates.network.graph import node_inputs
from emulator.surrogates.network.pignn import Architecture
from emulator.training.plan import Plan


def with_network_of(emulator: Emulator, start: Emulator) -> Emulator:
    """``emulator`` with a copy of the network of ``start``; all else is its own."""
    copies = [jnp.copy(leaf) for leaf in jax.tree.leaves(start.weights)]
    structure = jax.tree.structure(emulator.weights)
    return replace(emulator, weights=jax.tree.unflatten(structure, copies))


def start_record(start: Emulator) -> dict[str, Any]:
    """What tells the emulator a training began from."""
    return {
        "scene": start.scene.name,
        "scene_fingerprint": start.scene.fingerprint,
        "fingerprint": start.fingerprint,
    }


def architecture_from(
    start: Emulator, scene: Scene, plan: Plan, architecture: Architecture | None = None
) -> Architecture:
    """The architecture of ``start``, if ``scene`` and ``plan`` can begin from its network.

    Raises
    ------
    InputError
        Another architecture was asked for, theta or the node features are others, or a decoder's
        coefficients belong to the mechanical modes of one mesh.
    """
    theirs, there = start.architecture, f"the emulator of '{start.scene.name}'"
    if not plan.steps:
        raise InputError(
            f"recipe '{plan.recipe}' trains no network, so it cannot start from that of {there}"
        )
    ours = replace(architecture or theirs, decoder=plan.decoder)
    if len(start.basis) or (ours.decoder == "separable" and plan.order and plan.modes):
        raise InputError(
            f"starting '{scene.name}' from {there}: coefficients of mechanical modes mean nothing "
            "on another mesh; use a decoder without them, such as recipe network's, for both"
        )
    if ours != theirs:
        raise InputError(f"{there} has a network {theirs}; '{scene.name}' is to have {ours}")
    if scene.parameter_names != start.scene.parameter_names:
        raise InputError(
            f"{there} has parameters {', '.join(start.scene.parameter_names)}; "
            f"'{scene.name}' has {', '.join(scene.parameter_names)}"
        )
    widths = start.graph.node_features.shape[1], node_inputs(scene).shape[1]
    if widths[0] != widths[1]:
        raise InputError(
            f"{there} has {widths[0]} features a node, '{scene.name}' has {widths[1]}: one has "
            "supports that move, the other has not"
        )
    return theirs
