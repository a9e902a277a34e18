"""Checkpoints: weights, optimiser, plan and architecture, all that resuming a training needs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.store import fill_tree, named_leaves, read_arrays, save_arrays
from emulator.surrogates.network.pignn import Architecture
from emulator.training.plan import Plan

CHECKPOINT = "checkpoint.safetensors"


class State(NamedTuple):
    """Weights, optimiser state, optimiser steps done, and the loss of the last step."""

    weights: Any
    optimiser: Any
    done: int = 0
    loss: Any = float("nan")


@dataclass(frozen=True)
class Writer:
    """Writes the checkpoints of one training.

    fingerprint : of the scene, or of all scenes of a family.
    architecture : of the network, None without one.
    start : record of the emulator whose network training started from; empty when afresh.
    """

    path: Path
    fingerprint: str
    architecture: Architecture | None
    start: Mapping[str, Any] = field(default_factory=dict)

    def write(self, state: State, plan: Plan, seconds: float) -> None:
        """Replace the checkpoint; ``seconds`` is the time spent so far."""
        sizes = None if self.architecture is None else asdict(self.architecture)
        metadata = {
            "plan": json.dumps(asdict(plan)),
            "architecture": json.dumps(sizes),
            "start": json.dumps(dict(self.start)),
            "fingerprint": self.fingerprint,
            "seconds": repr(seconds),
            "loss": repr(float(state.loss)),
        }
        tree = {"weights": state.weights, "optimiser": state.optimiser, "step": state.done}
        save_arrays(self.path, named_leaves(tree), metadata)


class Checkpoint(NamedTuple):
    """The content of a checkpoint.

    architecture : None without a network. start : as in :class:`Writer`.
    seconds : spent until it was written.
    """

    plan: Plan
    architecture: Architecture | None
    start: dict[str, Any]
    seconds: float
    loss: float
    arrays: dict[str, np.ndarray]

    def restore(self, weights: Any, optimiser: Any) -> State:
        """The state, in the structure of ``weights`` and of the ``optimiser`` state."""
        tree = {"weights": weights, "optimiser": optimiser}
        filled = jax.tree.map(jnp.asarray, fill_tree(tree, self.arrays, "the checkpoint"))
        return State(filled["weights"], filled["optimiser"], int(self.arrays["step"]), self.loss)


def read_checkpoint(path: Path, fingerprint: str, name: str) -> Checkpoint:
    """The checkpoint at ``path``, which must be of the scene ``name`` with that fingerprint."""
    if not path.is_file():
        raise InputError(f"nothing to resume: checkpoint {path} does not exist")
    arrays, metadata = read_arrays(path)
    if metadata.get("fingerprint") != fingerprint:
        raise InputError(f"{path} belongs to another scene than '{name}'; train afresh")
    try:
        sizes = json.loads(metadata["architecture"])
        return Checkpoint(
            Plan(**json.loads(metadata["plan"])),
            sizes and Architecture.from_json(sizes),
            json.loads(metadata["start"]),
            float(metadata["seconds"]),
            float(metadata["loss"]),
            arrays,
        )
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} lacks or garbles {error}; train afresh") from error
