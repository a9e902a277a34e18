"""Emulators made of the networks released with Dalton et al. (2023).

The released network is Algorithm 1 with three differences: theta enters as it is, standardised but
without a logarithm; a node's final state sums the edges it receives, without sign; and its output
is the displacement in the model's own unit of length, with no scale. It has no other part.
"""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.energy import potential_energy
from emulator.geometry.mesh import frozen_array
from emulator.released.network import ReleasedNetwork, read_network
from emulator.released.scenes import published_scene, published_tests, theta_units, units
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network import Network
from emulator.surrogates.network.graph import AugmentedGraph
from emulator.surrogates.network.pignn import Architecture

_ARCHITECTURE = Architecture(edge_sum="receives")
_ROUNDS = _ARCHITECTURE.steps
# The release numbers its perceptrons in the order in which they are called.
_PERCEPTRONS = [
    "processor/encode_node",
    "processor/encode_edge",
    *(f"processor/rounds/{k}/{part}" for k in range(_ROUNDS) for part in ("edge", "node")),
    "decoder/encode_theta",
    *(f"decoder/components/{k}" for k in range(3)),
]
# Relative error of a prediction's energy that no network trained on the model leaves; the released
# ones leave 1e-4. Weights of another model have the same shapes.
_OTHER_ENERGY = 0.05


def released_network(model: str, root: str | Path) -> Emulator:
    """Return the released network of ``model``, as an emulator of ``published:<model>``.

    Parameters
    ----------
    model : ``TwistingBeam``, ``Liver`` or ``LeftVentricle``.
    root : a clone of the release, or its folder ``data``.

    Raises
    ------
    InputError
        Files that are missing or damaged, weights or a graph of another model, or a pickle that
        holds anything but arrays.
    """
    scene, released = published_scene(model, root), read_network(root, model)
    graph = AugmentedGraph(
        node_features=frozen_array(released.node_features, np.float32),
        edge_features=frozen_array(released.edge_features, np.float32),
        senders=frozen_array(released.senders, np.int32),
        receivers=frozen_array(released.receivers, np.int32),
        real=len(scene.mesh.nodes),
    )
    count = len(scene.parameters)
    if len(released.mean) != count:
        raise InputError(
            f"published data: theta of {model} has {len(released.mean)} means; expected {count}"
        )
    unit = theta_units(model)
    network = Network(
        architecture=_ARCHITECTURE,
        space=scene.space,
        graph=graph,
        scale=np.full(3, units(model).length),
        theta={"mean": released.mean * unit, "sd": released.sd * unit},
    ).filled(_rename_weights(released, model))
    emulator = Emulator(scene, network=network, record={"released": model})
    _check_energy(emulator, model, root)
    return emulator


def _rename_weights(released: ReleasedNetwork, model: str) -> dict[str, np.ndarray]:
    """Return the released weights by our names."""
    places = {f"FlaxMLP_{k}": place for k, place in enumerate(_PERCEPTRONS)}
    weights = {}
    for name, array in released.weights.items():
        owner, *rest = name.split("/")
        if owner == "LayerNorm_0":
            owner, rest = "processor", ["norm", *rest]
        elif owner in places and rest and rest[0].startswith("Dense_"):
            owner, rest = places[owner], ["layers", rest[0].removeprefix("Dense_"), *rest[1:]]
        elif owner in places and rest and rest[0] == "LayerNorm_0":
            owner, rest = places[owner], ["norm", *rest[1:]]
        else:
            raise InputError(f"published data: network of {model}: array '{name}' is unknown")
        weights["/".join((owner, *rest))] = array
    return weights


def _check_energy(emulator: Emulator, model: str, root: str | Path) -> None:
    """Refuse weights whose prediction is far from the stored solution's energy."""
    scene: Scene = emulator.scene
    thetas, tests = published_tests(model, root)

    @jax.jit
    def energy(theta: jax.Array) -> jax.Array:
        return potential_energy(scene)(emulator(theta), theta)

    prediction, reference = float(energy(thetas[0])), float(tests.energy[0])
    if not abs(prediction - reference) <= _OTHER_ENERGY * abs(reference):
        raise InputError(
            f"published data: these weights are not of {model}: at the first stored theta their "
            f"prediction has an energy of {prediction:.4g} mN mm, the solution {reference:.4g}"
        )
