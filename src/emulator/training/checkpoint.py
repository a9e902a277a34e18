"""Checkpoints: weights, optimiser, plan and architecture, so that nothing else need be said."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.store import fill_tree, read_arrays, save_tree
from emulator.surrogates.network.pignn import Architecture
from emulator.training.plan import Plan

CHECKPOINT = "checkpoint.safetensors"


class Checkpoint(NamedTuple):
    """What a checkpoint says of its training.

    start : of the emulator it began from, as in its record; empty where it began afresh.
    architecture : None in checkpoints that do not say.
    """

    path: Path
    plan: Plan
    architecture: Architecture | None
    start: dict[str, Any]
    seconds: float
    loss: float
    arrays: dict[str, np.ndarray]

    @property
    def step(self) -> int:
        """Optimiser steps done."""
        return int(self.arrays["['step']"])

    def restore(self, weights: Any, state: Any) -> tuple[Any, Any]:
        """Weights and optimiser state, in the structure of those given."""
        tree = fill_tree({"weights": weights, "state": state}, self.arrays, str(self.path))
        weights, state = jax.tree.map(jnp.asarray, (tree["weights"], tree["state"]))
        return weights, state


def write_checkpoint(
    path: Path,
    fingerprint: str,
    plan: Plan,
    architecture: Architecture,
    start: Mapping[str, Any],
    progress: tuple[Any, Any, int],
    seconds: float,
    loss: float,
) -> None:
    """Write weights, optimiser state and the steps done (``progress``) of a training."""
    weights, state, step = progress
    metadata = {
        "plan": json.dumps(asdict(plan)),
        "architecture": json.dumps(asdict(architecture)),
        "start": json.dumps(dict(start)),
        "fingerprint": fingerprint,
        "seconds": repr(seconds),
        "loss": repr(loss),
    }
    save_tree(path, {"weights": weights, "state": state, "step": np.asarray(step)}, metadata)


def read_checkpoint(path: Path, fingerprint: str, name: str) -> Checkpoint:
    """The checkpoint at ``path``, which must be of the scene ``name`` with that fingerprint."""
    if not path.is_file():
        raise InputError(f"nothing to resume: checkpoint {path} does not exist")
    arrays, metadata = read_arrays(path)
    if metadata.get("fingerprint") != fingerprint:
        raise InputError(f"{path} belongs to another scene than '{name}'; train afresh")
    sizes = json.loads(metadata.get("architecture", "null"))
    return Checkpoint(
        path,
        Plan(**json.loads(metadata["plan"])),
        sizes and Architecture(**{**sizes, "hidden": tuple(sizes["hidden"])}),
        json.loads(metadata.get("start", "{}")),
        float(metadata["seconds"]),
        float(metadata.get("loss", "nan")),
        arrays,
    )
