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
from emulator.fem.campaign import Runs
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import all_nodes
from emulator.surrogates.correction import correction_at, fit_correction, no_correction
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
_MODES = "modes"  # an array
_MOST_OUTPUTS = 30  # of which each has a process; more are a field, by its modes
_MOST_MODES, _LEFT = 30, 1e-6  # of a field: their number, and the share of variance beyond them


@dataclass(frozen=True, eq=False)
class OutputsMap:
    """The answer of a solver as a forward map.

    scene : the problem. nodes : the rows (k,) of the answer that are returned.
    """

    scene: ForwardProblem
    nodes: np.ndarray

    @abstractmethod
    def numbers(self, x: jax.Array) -> jax.Array:
        """Return all numbers of the answer, row by row, at a position (p,) in the box."""

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the rows (k, 3) at ``theta`` (p,); outputs are in the first column."""
        count = self.scene.components
        rows = self.numbers(self.scene.to_unit(theta)).reshape(-1, count)[self.nodes]
        return jnp.pad(rows, ((0, 0), (0, 3 - count)))

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the outputs, and whether theta is inside the box."""
        return inside_only(cast(ForwardMap, self), theta)

    def at(self, nodes: np.ndarray) -> Self:
        """Return the map of some of its rows."""
        rows = self.nodes[rows_of(cast(ForwardMap, self), nodes)]
        return replace(self, nodes=rows)


@dataclass(frozen=True, eq=False)
class TaughtOutputs(OutputsMap):
    """The answer of a solver that rounds of its runs have taught.

    outputs : the process of all numbers, or of the amounts of their modes, of positions in the box.
    data : the process of the data of the posterior for which the runs were made.
    record : what is told of the rounds.
    modes : the mean (n,) of the numbers and their modes, (1 + r, n); None where numbers are few.
    """

    outputs: DataProcess
    data: DataProcess
    record: Mapping[str, Any]
    modes: np.ndarray | None = None

    kind = "rounds"
    label = "process of the solver's runs"

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the problem, the rows and both processes."""
        return fingerprint_of(
            self.kind, self.scene.fingerprint, self.nodes, *self.arrays().values()
        )

    def numbers(self, x: jax.Array) -> jax.Array:
        """Return all outputs (n,) at a position (p,) in the box."""
        amounts = jnp.asarray(self.outputs.constant) + correction_at(self.outputs.correction, x)
        return amounts if self.modes is None else self.modes[0] + amounts @ self.modes[1:]

    def data_of(self, question: str) -> DataProcess | None:
        """Return the process of the data that ``question`` asks for; None where it is another."""
        return self.data if self.data.question == question else None

    def arrays(self) -> Arrays:
        """Return all that gives a value, by name."""
        parts = {_ALL: self.outputs, _DATA: self.data}
        arrays = {f"{part}/{n}": a for part, p in parts.items() for n, a in p.arrays().items()}
        return arrays if self.modes is None else arrays | {_MODES: self.modes}

    @classmethod
    def restored(cls, scene: ForwardProblem, arrays: Arrays) -> TaughtOutputs:
        """Return the map of :meth:`arrays`; ``KeyError`` where one is missing."""
        outputs, data = (DataProcess.restore(inside(arrays, part)) for part in (_ALL, _DATA))
        return cls(scene, all_nodes(scene), outputs, data, {}, arrays.get(_MODES))


def taught_outputs(
    scene: ForwardProblem, data: DataProcess, runs: Runs | None, record: Mapping[str, Any]
) -> TaughtOutputs:
    """Return the map whose answers are those of ``runs``; zeros where there are none yet."""
    size, p = scene.node_count * scene.components, len(scene.parameters)
    if runs is None:
        whole = DataProcess(_ALL, np.zeros(size), no_correction(1, p, size))
        return TaughtOutputs(scene, all_nodes(scene), whole, data, record)
    count = len(runs.theta)
    values = np.asarray(runs.displacement)[..., : scene.components].reshape(count, size)
    mean = values.mean(axis=0)
    amounts, scales, modes = values - mean, values.std(axis=0), None
    if size > _MOST_OUTPUTS:
        amounts, principal = scores_and_modes(amounts)
        modes = np.vstack([mean, principal])
        mean, scales = np.zeros(len(principal)), np.ones(len(principal))
    process = no_correction(1, p, len(mean))
    if count >= p + 2:
        x, slopes = np.asarray(scene.to_unit(runs.theta)), _slopes(scene, runs, modes)
        scales = np.where(scales > 0.0, scales, 1.0)
        process = fit_correction(x, amounts, scales, count, slopes=slopes)
    whole = DataProcess(_ALL, mean, process)
    return TaughtOutputs(scene, all_nodes(scene), whole, data, record, modes)


def _slopes(scene: ForwardProblem, runs: Runs, modes: np.ndarray | None) -> np.ndarray | None:
    """Return the derivatives (c, p, r) of the numbers of runs, or of the amounts of modes."""
    if runs.sensitivities is None:
        return None
    by_theta = np.asarray(runs.sensitivities)[..., : scene.components]
    by_theta = by_theta.reshape(*by_theta.shape[:2], -1)
    if modes is not None:
        by_theta = by_theta @ (modes[1:] / np.sum(modes[1:] ** 2, axis=1)[:, None]).T
    slopes: np.ndarray = by_theta * np.asarray(scene.space.rates(runs.theta))[:, :, None]
    return slopes


def scores_and_modes(outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Return scores (c, m) and modes (m, n) of standardised outputs (c, n).

    Each output is a mode if they are few. A field :math:`Y = U \Sigma V^T` has its principal
    components, down to a share of 1e-6 of the variance, with scores of unit mean square:

    .. math:: Y \approx S M, \quad S = \sqrt c\, U, \quad M = \Sigma V^T / \sqrt c .
    """
    if outputs.shape[1] <= _MOST_OUTPUTS:
        return outputs, np.eye(outputs.shape[1])
    vectors, sizes, modes = np.linalg.svd(outputs, full_matrices=False)
    left, root = 1.0 - np.cumsum(sizes**2) / np.sum(sizes**2), np.sqrt(len(outputs))
    count = min(int(np.searchsorted(-left, -_LEFT)) + 1, _MOST_MODES)
    return root * vectors[:, :count], sizes[:count, None] * modes[:count] / root
