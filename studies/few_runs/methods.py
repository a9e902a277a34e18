"""The methods compared, and the clock they are timed by."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np

from emulator import Simulator
from emulator.fem import Runs, run_campaign
from emulator.scenes import Scene
from emulator.surrogates.discrepancy import Discrepancy, Warp, fit, fit_discrepancy
from emulator.surrogates.discrepancy.kernel import Features, fit_lengths, fit_weights, fold
from emulator.surrogates.pod_gp import ReducedForward, fit_reduced
from emulator.surrogates.taylor import Expansion, expand

RIVAL_MODES = 40  # more cost scikit-learn time and, by the row with twice as many, gain nothing
RIVAL_STAGES = (30, 60, 120)  # runs after which its own fit starts the next ones
Map = Callable[[jax.Array], jax.Array]
"""Position in the box (p,) to displacement (n, 3) mm."""


def clock() -> np.ndarray:
    """Seconds (2,): the wall's, and this process's on all processors together."""
    return np.array([time.perf_counter(), time.process_time()])


@dataclass(frozen=True, eq=False)
class Clocked(Simulator):
    """A simulator that notes when it was last done with each theta."""

    marks: dict[bytes, np.ndarray] = field(default_factory=dict)

    def solve(self, theta, start=None):
        solution = super().solve(theta, start)
        self.marks[np.asarray(theta).tobytes()] = clock()
        return solution

    def sensitivities(self, u, theta):
        columns = jax.block_until_ready(super().sensitivities(u, theta))
        self.marks[np.asarray(theta).tobytes()] = clock()
        return columns

    def elapsed(self, thetas: jax.Array, begin: np.ndarray) -> np.ndarray:
        """Seconds (c, 2) from ``begin`` until each theta was done with, compilation included."""
        return np.stack([self.marks[np.asarray(theta).tobytes()] for theta in thetas]) - begin


def our_campaign(
    scene: Scene, thetas: jax.Array, order: int
) -> tuple[Expansion, Runs, np.ndarray, np.ndarray]:
    """Series about the centre, runs with slopes, seconds of the series (2,), until each run (c, 2).

    The first theta is the centre: its FEM run is the series' own.
    """
    begin = clock()
    simulator = Clocked(scene)
    series = expand(simulator, order=order)
    jax.block_until_ready((series.displacement, series.derivatives))
    expanded = clock() - begin
    runs = run_campaign(simulator, thetas, sensitivities=True, predictor=series)
    elapsed = simulator.elapsed(thetas, begin)
    elapsed[0] = expanded
    return series, runs, expanded, elapsed


def rival_campaign(scene: Scene, thetas: jax.Array) -> tuple[Runs, np.ndarray]:
    """Runs, and seconds (c, 2) until each; started by the nearest run or by the rival's own fit."""
    begin = clock()
    simulator = Clocked(scene)
    parts: list[Runs] = []
    start = None
    ends = [0, *(n for n in RIVAL_STAGES if n < len(thetas)), len(thetas)]
    for first, last in pairwise(ends):
        parts.append(run_campaign(simulator, thetas[first:last], predictor=start))
        so_far = Runs(*(jnp.concatenate(p) for p in zip(*(q[:3] for q in parts), strict=True)))
        if last < len(thetas):
            reduced = fit_rival(scene, so_far)
            start = jax.jit(lambda x, reduced=reduced: reduced(scene.from_unit(x)))
    return so_far, simulator.elapsed(thetas, begin)


def fit_rival(scene: Scene, runs: Runs, modes: int = RIVAL_MODES) -> ReducedForward:
    """POD + Gaussian processes of at most ``modes`` modes."""
    snapshots = np.asarray(runs.displacement).reshape(len(runs.theta), -1)
    size = np.linalg.svd(snapshots - snapshots.mean(axis=0), compute_uv=False)
    least = size[modes] / size[0] if len(size) > modes else 0.0
    return fit_reduced(scene, runs, truncation=max(1e-9, least))


def plain_kernel(scene: Scene, runs: Runs, series: Expansion, mean_map: Map | None) -> Discrepancy:
    """Our residual with a kernel that knows positions only."""
    with patch.object(fit, "_FEATURES", 0):
        return fit_discrepancy(scene, runs, series, mean_map)


def unscaled(warp: Warp, features: bool = True) -> Warp:
    """``warp`` with lengths of one, with its mechanical features or without."""
    coefficients = warp.coefficients if features else warp.coefficients[:, :0]
    size = len(warp.centre) + coefficients.shape[1]
    return warp._replace(coefficients=coefficients, inverse_lengths=jnp.ones(size))


def fit_values(scene: Scene, runs: Runs, warp: Warp, mean_map: Map | None) -> Discrepancy:
    """Our residual without slopes: the same kernel and likelihood on displacements alone.

    warp : of lengths one.
    """
    positions = scene.to_unit(runs.theta)
    fields = np.asarray(runs.displacement)
    if mean_map is not None:
        fields = fields - np.asarray(jax.jit(jax.vmap(mean_map))(positions))
    offset = fields.mean(axis=0)
    left, size, right = np.linalg.svd(
        (fields - offset).reshape(len(fields), -1), full_matrices=False
    )
    kept = size > 1e-7 * size[0]
    observations = jnp.asarray(left[:, kept] * np.sqrt(len(fields)))
    modes = right[kept] * size[kept, None] / np.sqrt(len(fields))
    known = jax.vmap(warp)(positions)
    features = Features(known, jnp.zeros((*known.shape, 0)))
    lengths = jnp.asarray(fit_lengths(features, observations[:, :20]))
    scaled = features.scaled(lengths)
    values, slopes = fold(scaled, fit_weights(scaled, observations))
    return Discrepancy(
        warp._replace(inverse_lengths=lengths),
        scaled.value,
        values,
        slopes,
        jnp.asarray(offset),
        jnp.asarray(modes.reshape(-1, *offset.shape)),
    )
