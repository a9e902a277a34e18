"""Starting a training from the network of another emulator.

Encoders, messages and decoders are shared by all nodes, so their weights fit any mesh (Dalton et
al. 2023, Appendix E). Series, scale and graph belong to one scene and are never carried over; the
ranges of the parameters may differ, because the network takes positions in the unit box.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from emulator.catalogue import finer_of
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import Emulator
from emulator.surrogates.coarse import carried
from emulator.surrogates.network.family import FamilyNetwork, on_body
from emulator.surrogates.network.graph import node_inputs
from emulator.surrogates.network.pignn import Architecture
from emulator.training.plan import Plan


def with_weights(emulator: Emulator, weights: Any) -> Emulator:
    """``emulator`` with other weights of its network."""
    assert emulator.network is not None, "only a network has weights"
    return replace(emulator, network=replace(emulator.network, weights=weights))


def with_network_of(emulator: Emulator, start: Emulator) -> Emulator:
    """``emulator`` with a copy of the weights of ``start``; all else is its own."""
    assert emulator.network is not None, "only a network has weights"
    assert start.network is not None, "only a network has weights"
    copies = [jnp.copy(leaf) for leaf in jax.tree.leaves(start.network.weights)]
    structure = jax.tree.structure(emulator.network.weights)
    return with_weights(emulator, jax.tree.unflatten(structure, copies))


def family_on(start: Emulator, scene: Scene, plan: Plan) -> FamilyNetwork:
    """The network that ``start`` has learned from a family, on ``scene``.

    Raises
    ------
    InputError
        A plan that would train it further, or a scene it cannot know.
    """
    assert start.family is not None, "asked only of a family's"
    if plan.steps or not (plan.discrepancy or plan.as_learned or plan.sweeps):
        raise InputError(
            f"recipe '{plan.recipe}' cannot start from a network that has learned a family of "
            "bodies; use recipe family or sweeps, without any FEM run, or mechanics"
        )
    return on_body(start.family.learned, scene)


def on_finer(start: Emulator | None, scene: Scene, plan: Plan) -> Emulator:
    """``start``, an emulator on the mesh that the scene's is finer than, on ``scene``.

    Raises
    ------
    InputError
        No such emulator, a scene that is not on a finer mesh, one of another body, or a plan that
        begins at a series as well.
    """
    body = finer_of(scene)
    if start is None:
        raise InputError(
            f"recipe '{plan.recipe}' stands on an emulator on the coarser mesh; give it as the "
            "start"
        )
    if plan.order:
        raise InputError(
            f"recipe '{plan.recipe}': an emulator on the coarser mesh to stand on, and a series of "
            f"order {plan.order} to begin at; give one of them"
        )
    if start.scene.fingerprint != body.coarse.fingerprint:
        raise InputError(
            f"the emulator to start from is of scene '{start.scene.name}' on another mesh; "
            f"expected one of the mesh that finer:{scene.name} refines"
        )
    return Emulator(scene, coarse=carried(start.parts, body))


def start_record(start: Emulator) -> dict[str, Any]:
    """Name and fingerprints of the emulator whose weights training started from."""
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
        ``start`` has no network or another architecture than asked for, theta or the node features
        differ, or a decoder's coefficients belong to the mechanical modes of one mesh.
    """
    there, network = f"the emulator of '{start.scene.name}'", start.network
    if not plan.steps:
        raise InputError(
            f"recipe '{plan.recipe}' trains no network, so it cannot start from that of {there}"
        )
    if network is None:
        raise InputError(
            f"{there} has no network to start from, only {' + '.join(start.parts) or 'nothing'}; "
            "train it with recipe network"
        )
    theirs = network.architecture
    ours = replace(architecture or theirs, decoder=plan.decoder)
    if len(network.basis) or (ours.decoder == "separable" and plan.order and plan.modes):
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
    _check_features(network.graph.node_features.shape[1], scene, there)
    return theirs


def _check_features(width: int, scene: Scene, there: str) -> None:
    """Refuse a scene whose nodes have another number of features than ``width``."""
    ours = node_inputs(scene).shape[1]
    if width != ours:
        raise InputError(
            f"{there} has {width} features a node, '{scene.name}' has {ours}: one has "
            "supports that move, the other has not"
        )
