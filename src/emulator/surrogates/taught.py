"""An emulator that rounds of FEM runs have taught where a posterior is.

The runs are chosen for one run's data, so the map is made and kept with that run
(:mod:`calibrate.project.rounds`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.core.errors import InputError
from emulator.core.store import inside
from emulator.scenes.scene import Scene, all_nodes
from emulator.surrogates.emulator import PARTS, CachedEmulator, Emulator
from emulator.surrogates.part import arrays_of, together
from emulator.surrogates.protocol import (
    Arrays,
    ForwardKind,
    ForwardMap,
    Ingredients,
    Option,
    Options,
)


@dataclass(frozen=True, eq=False)
class TaughtEmulator(CachedEmulator):
    """An emulator over some nodes, of FEM runs that were made for one posterior."""

    kind = "rounds"
    label = "emulator by rounds of FEM"


def taught(emulator: Emulator) -> TaughtEmulator:
    """Return the forward map of ``emulator`` over all nodes."""
    nodes = all_nodes(emulator.scene)
    cached = [part.cache(nodes) for part in emulator.parts.values()]
    return TaughtEmulator(emulator, together(cached, len(nodes)), nodes)


def _refuse(_: Ingredients, __: Options) -> ForwardMap:
    raise InputError(
        "forward map 'rounds' is taught by the data of one run: calibrate infer makes it; for a "
        "map without data, train an emulator"
    )


def _to_arrays(forward: ForwardMap) -> Arrays:
    assert isinstance(forward, TaughtEmulator)
    return {name: np.asarray(array) for name, array in arrays_of(forward.emulator.parts).items()}


def _from_arrays(scene: Scene, arrays: Arrays) -> TaughtEmulator:
    present = {name: inside(arrays, name) for name in PARTS}
    parts = {n: PARTS[n].restore(scene, {}, part) for n, part in present.items() if part}
    return taught(Emulator(scene, **parts))  # type: ignore[arg-type]


ROUNDS = ForwardKind(
    "rounds",
    "an emulator of FEM runs that infer makes where the posterior is; what a mesh without an "
    "emulator gets",
    _refuse,
    (Option("most_runs", 64, "FEM runs, each in every load state, at most", least=8),),
    _to_arrays,
    _from_arrays,
)
