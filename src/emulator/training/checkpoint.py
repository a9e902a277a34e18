"""The checkpoints of a training: weights, optimiser, plan and architecture, to resume from."""

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

from emulator.core.errors import InputError, look_up
from emulator.core.schema import read_as
from emulator.core.store import fill_tree, named_leaves, read_arrays, save_arrays
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network.pignn import Architecture

CHECKPOINT, SWEEPS = "checkpoint.safetensors", "sweeps.safetensors"

Record = dict[str, Any]
"""How an emulator was trained, as plain JSON: its ``plan``, ``final_loss`` and more."""


class State(NamedTuple):
    """The state between two optimiser steps.

    weights, optimiser : the weights of the network and the state of the optimiser.
    done : the number of steps done.
    loss : the loss of the last step.
    """

    weights: Any
    optimiser: Any
    done: int = 0
    loss: Any = float("nan")


@dataclass(frozen=True)
class Session:
    """A training that begins or is resumed, its checkpoint and its clock.

    path : the file of the checkpoint.
    fingerprint : the fingerprint of the scene, or of all scenes of a family.
    plan : the :class:`~emulator.training.plan.Plan` that is followed.
    architecture : the sizes of the network; ``None`` without one.
    began : the time it began, on the performance counter, less the time spent before it was
        resumed.
    start : the record of the emulator from which training started; empty when afresh.
    arrays, loss : the arrays and loss of the checkpoint to resume from; no arrays at the beginning.
    """

    path: Path
    fingerprint: str
    plan: Any
    architecture: Architecture | None = None
    began: float = field(default_factory=time.perf_counter)
    start: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, np.ndarray] | None = None
    loss: float = float("nan")

    def resumed(self, name: str, plan_kinds: Mapping[str, type]) -> Session:
        """Return the training whose checkpoint is at ``path``, with its own plan and sizes.

        name : the name of the emulated scene, for messages.
        plan_kinds : the classes of plans by the name of their recipe, to read a checkpoint's.

        Raises :class:`InputError`: no checkpoint to resume, a damaged one, or one of another scene.
        """
        path = self.path
        if not path.is_file():
            raise InputError(f"nothing to resume: checkpoint {path} does not exist")
        arrays, metadata = read_arrays(path)
        if metadata.get("fingerprint") != self.fingerprint:
            raise InputError(f"{path} belongs to another scene than '{name}'; train afresh")
        try:
            sizes = json.loads(metadata["architecture"])
            options = json.loads(metadata["plan"])
            kind = look_up(plan_kinds, options["recipe"], "recipe")
            return replace(
                self,
                plan=read_as(kind, options, str(path)),
                architecture=(
                    read_as(Architecture, sizes, str(path)) if sizes else self.architecture
                ),
                began=self.began - float(metadata["seconds"]),
                start=json.loads(metadata["start"]),
                arrays=arrays if len(arrays) > 1 else None,  # weights, besides the number of steps
                loss=float(metadata["loss"]),
            )
        except (KeyError, TypeError) as error:
            raise InputError(f"{path} lacks or garbles {error}; train afresh") from error

    @property
    def seconds(self) -> float:
        """The time spent so far."""
        return time.perf_counter() - self.began

    def write(self, state: State, total: int) -> None:
        """Replace the checkpoint; ``total`` is the number of steps aimed at."""
        sizes = None if self.architecture is None else asdict(self.architecture)
        metadata = {
            "plan": json.dumps(asdict(self.plan.with_counts(steps=total))),
            "architecture": json.dumps(sizes),
            "start": json.dumps(dict(self.start)),
            "fingerprint": self.fingerprint,
            "seconds": repr(self.seconds),
            "loss": repr(float(state.loss)),
        }
        tree = {"weights": state.weights, "optimiser": state.optimiser, "step": state.done}
        save_arrays(self.path, named_leaves(tree), metadata)

    def write_plan(self, plan: Any) -> None:
        """Write a checkpoint without weights, for a training that has no optimiser step so far."""
        replace(self, plan=plan).write(State({}, ()), getattr(plan, "steps", 0))

    def first(self, state: State, total: int) -> State:
        """Return the checkpoint's state; without one ``state``, which is written."""
        if self.arrays is None:
            self.write(state, total)
            return state
        tree = {"weights": state.weights, "optimiser": state.optimiser}
        filled = jax.tree.map(jnp.asarray, fill_tree(tree, self.arrays, "the checkpoint"))
        return State(filled["weights"], filled["optimiser"], int(self.arrays["step"]), self.loss)

    def finished(self, emulator: Emulator, record: Record) -> Emulator:
        """Return ``emulator`` with its record: where it started, and the seconds it took."""
        start = {"start": dict(self.start)} if self.start else {}
        return replace(emulator, record={**record, **start, "seconds": round(self.seconds, 1)})


def remove_checkpoint(folder: str | Path) -> None:
    """Remove the checkpoints of the training and of its sweeps in ``folder``, if any."""
    for name in (CHECKPOINT, SWEEPS):
        (Path(folder) / name).unlink(missing_ok=True)
