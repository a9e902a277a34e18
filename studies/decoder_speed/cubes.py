"""The twisting cube from coarse to fine: a full field, and 24 landmarks, by size of the mesh.

A cached emulator evaluates a sum of modes, and the time does not depend on their values. So none is
trained: the series comes from one FEM solve, and the network's weights are random.
"""

import time
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.timing import Function, batched, clocked, loop, milliseconds, per_call, unseen

import emulator as em
from calibrate.measurements import Landmarks, landmarks, spread_landmarks
from emulator.surrogates import Architecture, CachedEmulator, Emulator, augment
from emulator.surrogates.network import Network, fresh
from emulator.surrogates.taylor import expand

LANDMARKS = 24
ROUNDS = 5
ARCHITECTURE = Architecture(decoder="separable", modes=32)


class Cube(NamedTuple):
    """One mesh: its emulator over all nodes, the observation, and the seconds to make them."""

    cached: CachedEmulator
    seen: Landmarks
    seconds: dict[str, float]


def drawn(network: Network, seed: int) -> Network:
    """``network`` with random weights, so that no compiler can drop a last layer of zeros."""
    rng = np.random.default_rng(seed)
    leaves, structure = jax.tree.flatten(network.weights)
    leaves = [leaf + 0.01 * rng.normal(size=leaf.shape).astype(np.float32) for leaf in leaves]
    return replace(network, weights=jax.tree.unflatten(structure, leaves))


def cube(cells: int, order: int, points: np.ndarray | None, seed: int) -> Cube:
    """The cube of ``cells`` cells an edge, observed at ``points`` (d, 3) mm, by default its own."""
    scene = em.scenes.twisting_cube(cells=cells, order=1)
    simulator = em.Simulator(scene)
    seconds = {}
    seconds["series"], series = clocked(expand, simulator, None, order)
    seconds["graph"], graph = clocked(augment, scene)
    network = drawn(fresh(scene, graph, ARCHITECTURE, np.ones(3), seed), seed)
    emulator = Emulator(scene, taylor=series, network=network)
    begin = time.perf_counter()
    cached = emulator.cache()
    seconds["cache"] = time.perf_counter() - begin
    if points is None:
        points = spread_landmarks(scene, LANDMARKS, seed)
    return Cube(cached, landmarks(scene, points), seconds)


def gradient(cube: Cube) -> Function:
    """Value and gradient of the landmarks' squared displacements."""
    at = cube.cached.at(cube.seen.nodes)
    return jax.jit(jax.value_and_grad(lambda theta: jnp.sum(cube.seen(at(theta), theta) ** 2)))


def in_turns(cubes: list[Cube], functions: list[Function], count: int) -> list[float]:
    """Seconds per theta in a compiled loop; meshes take turns, so that other load hits them all."""
    loops = [loop(function) for function in functions]
    turns = np.array(
        [
            [
                per_call(run, unseen(c.cached.scene, 2 * count).reshape(2, count, -1)) / count
                for c, run in zip(cubes, loops, strict=True)
            ]
            for _ in range(ROUNDS)
        ]
    )
    return [float(v) for v in np.median(turns, axis=0)]


def study(sizes: list[int], order: int, calls: int, batch: int, seed: int) -> list[dict]:
    """One case for each mesh, from the coarsest to the finest."""
    cubes: list[Cube] = []
    for cells in sorted(sizes):
        cubes.append(cube(cells, order, cubes[0].seen.points if cubes else None, seed))
    fields = in_turns(cubes, [c.cached for c in cubes], calls)
    seen = in_turns(cubes, [gradient(c) for c in cubes], 10 * calls)
    return [
        case(c, field, at, calls, batch) for c, field, at in zip(cubes, fields, seen, strict=True)
    ]


def case(cube: Cube, field_s: float, landmarks_s: float, calls: int, batch: int) -> dict:
    """Times of one mesh."""
    cached, scene = cube.cached, cube.cached.scene
    theta, seen = unseen(scene, 1)[0], gradient(cube)
    parts = cached.at(cube.seen.nodes)(theta) - cached(theta)[cube.seen.nodes]
    nodes = len(scene.mesh.nodes)
    found = {
        "name": f"twisting cube, {nodes} nodes",
        "status": "done",
        "nodes": nodes,
        "modes": len(cached.coefficients(theta)),
        "landmark_nodes": len(cube.seen.nodes),
        "field_call_s": per_call(jax.jit(lambda t: cached(t)), unseen(scene, calls)),
        "field_loop_s": field_s,
        "field_batch_s": batched(cached, scene, batch),
        "landmarks_call_s": per_call(seen, unseen(scene, 10 * calls)),
        "landmarks_loop_s": landmarks_s,
        "landmarks_batch_s": batched(seen, scene, batch),
        **{f"{name}_s": seconds for name, seconds in cube.seconds.items()},
        "largest_gap_mm": float(jnp.abs(parts).max()),
    }
    print(
        f"{found['name']:28s} full field {milliseconds(found['field_call_s']):>12s}, in a loop "
        f"{milliseconds(field_s):>12s}, in a batch {milliseconds(found['field_batch_s']):>12s};  "
        f"landmarks, value and gradient {milliseconds(landmarks_s)}",
        flush=True,
    )
    return found
