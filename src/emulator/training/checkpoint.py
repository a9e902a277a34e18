"""A training's checkpoints: weights, optimiser, plan and architecture, all that resuming needs."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.store import fill_tree, named_leaves, read_arrays, save_arrays
from emulator.surrogates.network.pignn import Architecture
from emulator.training.plan import Plan

CHECKPOINT, SWEEPS = "checkpoint.safetensors", "sweeps.safetensors"


class State(NamedTuple):
    """Weights, optimiser state, optimiser steps done, and the loss of the last step."""

    weights: Any
    optimiser: Any
    done: int = 0
    loss: Any = float("nan")


@dataclass(frozen=True)
class Session:
    """One training, begun or resumed: what its checkpoints say of it, and its clock.

    path : of the checkpoint.
    fingerprint : of the scene, or of all scenes of a family.
    architecture : of the network, None without one.
    start : record of the emulator whose network training started from; empty when afresh.
    began : of the performance counter, less the time spent before it was resumed.
    arrays, loss : of the checkpoint it goes on from; no arrays when it begins.
    """

    path: Path
    fingerprint: str
    plan: Plan
    architecture: Architecture | None
    began: float
    start: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, np.ndarray] | None = None
    loss: float = float("nan")

    @property
    def seconds(self) -> float:
        """Time spent so far."""
        return time.perf_counter() - self.began

    def write(self, state: State, total: int) -> None:
        """Replace the checkpoint; ``total`` is the number of steps aimed at."""
        sizes = None if self.architecture is None else asdict(self.architecture)
        metadata = {
            "plan": json.dumps(asdict(replace(self.plan, steps=total))),
            "architecture": json.dumps(sizes),
            "start": json.dumps(dict(self.start)),
            "fingerprint": self.fingerprint,
            "seconds": repr(self.seconds),
            "loss": repr(float(state.loss)),
        }
        tree = {"weights": state.weights, "optimiser": state.optimiser, "step": state.done}
        save_arrays(self.path, named_leaves(tree), metadata)

    def announce(self) -> None:
        """A checkpoint without weights: the plan, of a training whose sweeps come first."""
        self.write(State({}, (), 0), self.plan.steps)

    def first(self, state: State, total: int) -> State:
        """The state to go on from: the checkpoint's, else ``state``, which then is kept."""
        if self.arrays is None:
            self.write(state, total)
            return state
        tree = {"weights": state.weights, "optimiser": state.optimiser}
        filled = jax.tree.map(jnp.asarray, fill_tree(tree, self.arrays, "the checkpoint"))
        return State(filled["weights"], filled["optimiser"], int(self.arrays["step"]), self.loss)

    def __call__(self, state: State, total: int) -> int:
        """Keep the state as often as the plan says, and after the last step; a hook."""
        if state.done % self.plan.checkpoint_every == 0 or state.done == total:
            self.write(state, total)
        return total


def open_session(
    folder: str | Path,
    fingerprint: str,
    name: str,
    plan: Plan,
    architecture: Architecture | None,
    *,
    resume: bool,
) -> Session:
    """A training in ``folder``: one that begins, or the one whose checkpoint is there.

    Parameters
    ----------
    name : of what has that ``fingerprint``, for messages.
    plan, architecture : where it begins; a checkpoint has its own.

    Raises
    ------
    InputError
        No checkpoint to resume, a damaged one, or one of another scene.
    """
    path, now = Path(folder) / CHECKPOINT, time.perf_counter()
    if not resume:
        return Session(path, fingerprint, plan, architecture, now)
    if not path.is_file():
        raise InputError(f"nothing to resume: checkpoint {path} does not exist")
    arrays, metadata = read_arrays(path)
    if metadata.get("fingerprint") != fingerprint:
        raise InputError(f"{path} belongs to another scene than '{name}'; train afresh")
    try:
        sizes = json.loads(metadata["architecture"])
        return Session(
            path,
            fingerprint,
            Plan(**json.loads(metadata["plan"])),
            Architecture.from_json(sizes) if sizes else architecture,
            now - float(metadata["seconds"]),
            json.loads(metadata["start"]),
            arrays if len(arrays) > 1 else None,  # weights, besides the number of steps
            float(metadata["loss"]),
        )
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} lacks or garbles {error}; train afresh") from error


def remove_checkpoint(folder: str | Path) -> None:
    """Remove the checkpoint in ``folder``, and that of its sweeps, if they are there."""
    for name in (CHECKPOINT, SWEEPS):
        (Path(folder) / name).unlink(missing_ok=True)
