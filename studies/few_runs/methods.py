"""The methods compared, and the clock that times them."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np

from emulator import Simulator
from emulator.core.gaussian_process import Features, fit_lengths, fit_weights, fold
from emulator.fem import Runs, run_campaign
from emulator.scenes import Scene
from emulator.surrogates import discrepancy
from emulator.surrogates.discrepancy import Discrepancy, Warp, fit_discrepancy
from emulator.surrogates.pod_gp import ReducedForward, fit_reduced
from emulator.surrogates.taylor import Expansion, expand

RIVAL_MODES = 40  # with twice as many, scikit-learn takes longer and the error is the same
RIVAL_STAGES = (30, 60, 120)  # runs after which its own fit predicts the starts of the next
Map = Callable[[jax.Array], jax.Array]
"""Position in the box (p,) to displacement (n, 3) mm."""


def clock() -> np.ndarray:
    """Seconds (2,): wall clock, and processor time of this process over all cores."""
    return np.array([time.perf_counter(), time.process_time()])


@dataclass(frozen=True, eq=False)
class Clocked(Simulator):
    """A simulator that records when it last finished each theta."""

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
        """Seconds (c, 2) from ``begin`` until each theta was finished, compilation included."""
        return np.stack([self.marks[np.asarray(theta).tobytes()] for theta in thetas]) - begin


def our_campaign(
    scene: Scene, thetas: jax.Array, order: int
) -> tuple[Expansion, Runs, np.ndarray, np.ndarray]:
    """Series about the centre, runs with sensitivities, seconds of the series and until each run.

    Seconds have shapes (2,) and (c, 2). The first theta is the centre, whose run is the series'.
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
    """Runs, and seconds (c, 2) until each; starts are the nearest run or the rival's own fit."""
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
    """Our discrepancy model with a kernel of positions only."""
    with patch.object(discrepancy, "_FEATURES", 0):
        return fit_discrepancy(scene, runs, series, mean_map)


def unscaled(warp: Warp, features: bool = True) -> Warp:
    """``warp`` with all lengths 1, with or without its mechanical features."""
    coefficients = warp.coefficients if features else warp.coefficients[:, :0]
    size = len(warp.centre) + coefficients.shape[1]
    return warp._replace(coefficients=coefficients, inverse_lengths=jnp.ones(size))


def fit_values(scene: Scene, runs: Runs, warp: Warp, mean_map: Map | None) -> Discrepancy:
    """Our discrepancy model without sensitivities: its kernel and likelihood, displacements alone.

    warp : features with all lengths 1.
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
    values, derivatives = fold(scaled, fit_weights(scaled, observations))
    return Discrepancy(
        warp._replace(inverse_lengths=lengths),
        scaled.value,
        values,
        derivatives,
        jnp.asarray(offset),
        jnp.asarray(modes.reshape(-1, *offset.shape)),
    )
