"""Forward maps of external problems: Gaussian processes of a solver's outputs."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.store import inside
from emulator.external.problem import ExternalProblem
from emulator.fem.campaign import Runs
from emulator.scenes.scene import all_nodes
from emulator.surrogates.correction import Correction, correction_at, fit_correction, no_correction
from emulator.surrogates.protocol import (
    Arrays,
    ForwardMap,
    Prediction,
    fingerprint_of,
    inside_only,
    rows_of,
)
from emulator.surrogates.taught import DataProcess

_ALL, _DATA = "outputs", "data"  # prefixes of arrays


@dataclass(frozen=True, eq=False)
class OutputsMap:
    """The outputs of a solver as a forward map.

    scene : the problem. nodes : the rows (k,) of the outputs that are returned.
    """

    scene: ExternalProblem
    nodes: np.ndarray

    @abstractmethod
    def numbers(self, x: jax.Array) -> jax.Array:
        """Return all outputs (n,) at a position (p,) in the box."""

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the outputs (k, 3) in the first column, at ``theta`` (p,)."""
        numbers = self.numbers(self.scene.to_unit(theta))
        return jnp.zeros((len(self.nodes), 3)).at[:, 0].set(numbers[self.nodes])

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the outputs, and whether theta is inside the box."""
        return inside_only(cast(ForwardMap, self), theta)

    def at(self, nodes: np.ndarray) -> Self:
        """Return the map of some of its rows."""
        rows = self.nodes[rows_of(cast(ForwardMap, self), nodes)]
        return replace(self, nodes=rows)


@dataclass(frozen=True, eq=False)
class TaughtOutputs(OutputsMap):
    """The outputs of a solver that rounds of its runs have taught.

    outputs : the process of all outputs, of positions in the box.
    data : the process of the data of the posterior for which the runs were made.
    record : what is told of the rounds.
    """

    outputs: DataProcess
    data: DataProcess
    record: Mapping[str, Any]

    kind = "rounds"
    label = "process of the solver's runs"

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the problem, the rows and both processes."""
        arrays = [*self.outputs.arrays().values(), *self.data.arrays().values()]
        return fingerprint_of(self.kind, self.scene.fingerprint, self.nodes, *arrays)

    def numbers(self, x: jax.Array) -> jax.Array:
        """Return all outputs (n,) at a position (p,) in the box."""
        return jnp.asarray(self.outputs.constant) + correction_at(self.outputs.correction, x)

    def data_of(self, question: str) -> DataProcess | None:
        """Return the process of the data that ``question`` asks for; None where it is another."""
        return self.data if self.data.question == question else None

    def arrays(self) -> Arrays:
        """Return all that gives a value, by name."""
        parts = {_ALL: self.outputs, _DATA: self.data}
        return {f"{part}/{n}": a for part, p in parts.items() for n, a in p.arrays().items()}

    @classmethod
    def restored(cls, scene: ExternalProblem, arrays: Arrays) -> TaughtOutputs:
        """Return the map of :meth:`arrays`; ``KeyError`` where one is missing."""
        outputs, data = (DataProcess.restore(inside(arrays, part)) for part in (_ALL, _DATA))
        return cls(scene, all_nodes(scene), outputs, data, record={})


def taught_outputs(
    scene: ExternalProblem, data: DataProcess, runs: Runs | None, record: Mapping[str, Any]
) -> TaughtOutputs:
    """Return the map whose outputs are those of ``runs``; zeros where there are none yet."""
    outputs, count = np.zeros(scene.node_count), len(scene.parameters)
    process = no_correction(1, count, len(outputs))
    if runs is not None:
        outputs, process = _process_of(scene, runs)
    whole = DataProcess(_ALL, outputs, process)
    return TaughtOutputs(scene, all_nodes(scene), whole, data, record)


def _process_of(scene: ExternalProblem, runs: Runs) -> tuple[np.ndarray, Correction]:
    """Return the mean (n,) of the outputs of runs, and the process of their differences to it."""
    values = np.asarray(runs.displacement)[..., 0]
    mean, sd = values.mean(axis=0), values.std(axis=0)
    slopes = None
    if runs.sensitivities is not None:
        by_theta = np.asarray(runs.sensitivities)[..., 0]  # (c, p, n)
        slopes = by_theta * np.asarray(scene.space.rates(runs.theta))[:, :, None]
    x, scales = np.asarray(scene.to_unit(runs.theta)), np.where(sd > 0.0, sd, 1.0)
    if len(x) < x.shape[1] + 2:
        return mean, no_correction(1, x.shape[1], len(mean))
    return mean, fit_correction(x, values - mean, scales, len(x), slopes=slopes)
