"""Bands of frames given the left cavity's volume, and how many points of a frame they hold.

A draw of the posterior knows the heart but not the pressure of another frame: that is where the
left cavity has the volume given. The right pressure follows that of any frame that was seen. What
the surfaces miss has the sds that were inferred, and so has what a volume misses, the sum of errors
that correlate over the surface.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.distance import cdist
from studies.common.output import Case
from studies.human_heart.heart import LENGTH, SURFACES, surfaces_of

import calibrate as cal
from calibrate.measurements.collection import observations
from calibrate.measurements.frames import along_normals, spread_evenly
from calibrate.measurements.surface import SurfacePoints
from calibrate.measurements.volume import CavityVolume
from emulator.core.errors import InputError
from emulator.core.gaussian_process import CORRELATIONS
from emulator.geometry.discretisation import facet_rule
from emulator.geometry.facets import MM3_PER_ML, nodal_areas
from emulator.scenes import Scene
from emulator.surrogates.protocol import ForwardMap

KEPT_APART = ("f017", "f019", "f021", "f023")
VOLUMES = np.arange(140.0, 186.0, 3.0)  # mL, of the left cavity
POINTS = 200  # of a surface
_PRESSURES, _DRAWS, _SEED = 12, 240, 7
_LEVELS = (0.05, 0.5, 0.95)


def bands_of(found: cal.Posterior, scene: Scene, forward: ForwardMap, quick: bool) -> Case:
    """5, 50 and 95 % of normal distances and of the right volume, at each left volume.

    Distances are from the imaged frame, at points on its mesh.
    """
    rng = np.random.default_rng(_SEED)
    count = 20 if quick else POINTS
    parts = {
        name: SurfacePoints.of(scene, name, spread_evenly(scene.mesh, name, count))
        for name in SURFACES
    }
    cavities = {name: CavityVolume(scene, name) for name in SURFACES[:2]}
    observe = observations({**{f"surface:{n}": p for n, p in parts.items()},
                            **{f"volume:{n}": c for n, c in cavities.items()}})  # fmt: skip
    at = forward.at(observe.nodes)
    seen = jax.jit(jax.vmap(lambda theta: observe(at(theta)[None], theta[None])))
    draws = found.draws()
    rows = rng.choice(len(next(iter(draws.values()))), 24 if quick else _DRAWS)
    states = list(found.model.states.states)
    of_state = np.asarray([found.thetas(state) for state in states])
    chosen = rng.integers(len(states), size=len(rows))
    thetas = of_state[chosen, rows]
    column = scene.parameter_names.index("pressure")
    low, high = scene.parameters[column].low, scene.parameters[column].high
    values = []
    for pressure in np.linspace(low, high, _PRESSURES):
        each = seen(jnp.asarray(thetas).at[:, column].set(pressure))
        values.append({name: np.asarray(value) for name, value in each.items()})
    by_name = {name: np.stack([v[name] for v in values]) for name in values[0]}
    left = by_name.pop(f"volume:{SURFACES[0]}")
    areas = {n: _area(scene, n) for n in SURFACES}
    bands: Case = {"left_volume": VOLUMES.tolist(), "points": {}, "normals": {}}
    for name, part in parts.items():
        bands["points"][name] = part.points.round(4).tolist()
        bands["normals"][name] = part.normals.round(6).tolist()
    reached = [float(((left.min(axis=0) <= v) & (v <= left.max(axis=0))).mean()) for v in VOLUMES]
    bands["share_of_draws_that_reach_it"] = reached
    for name, value in by_name.items():
        sd = _noise(draws, rows, name, parts, areas)
        at_volume = np.stack(
            [_at(v, left, value) + sd * rng.normal(size=value.shape[1:]) for v in VOLUMES]
        )
        quantiles = np.quantile(at_volume, _LEVELS, axis=1)
        bands[name] = quantiles.round(2).tolist()
    return bands


def _area(scene: Scene, name: str) -> float:
    """The area of a surface at rest, mm2."""
    facets = scene.mesh.facet_set(name)
    rule = facet_rule(scene.mesh.order, 4)
    return float(nodal_areas(scene.mesh.nodes[facets], rule).sum())


def _at(volume: float, left: np.ndarray, value: np.ndarray) -> np.ndarray:
    """A value (k, s, ...) at k pressures, where the left volume (k, s) has this value."""
    found = np.empty(value.shape[1:])
    for s in range(left.shape[1]):
        above = np.clip(np.searchsorted(left[:, s], volume), 1, len(left) - 1)
        share = (volume - left[above - 1, s]) / (left[above, s] - left[above - 1, s])
        found[s] = value[above - 1, s] + share * (value[above, s] - value[above - 1, s])
    return found


def _noise(
    draws: dict[str, np.ndarray], rows: np.ndarray, name: str, parts: dict[str, SurfacePoints],
    areas: dict[str, float],
) -> np.ndarray:  # fmt: skip
    """The sd of a number of this observation by noise, by draw."""
    kind, _, surface = name.partition(":")
    if kind == "surface":
        sds = [draws[f"{noise}_{name}"][rows] for noise in ("noise_sd", "spatial_sd")]
        return np.hypot(*sds)[:, None]
    points = parts[surface].points
    correlation = CORRELATIONS["matern32"](cdist(points, points, "sqeuclidean") / LENGTH**2)
    share = areas[surface] / len(points)  # of the surface, mm2
    return (
        draws[f"spatial_sd_surface:{surface}"][rows]
        * share
        * np.sqrt(correlation.sum())
        / MM3_PER_ML
    )


def judged(bands: Case, data: Path, frames: tuple[str, ...]) -> Case:
    """How much of each frame lies in its bands, given its left volume alone."""
    found: Case = {}
    for frame in frames:
        surfaces = surfaces_of(data, frame)
        left, right = (surfaces[name].volume / MM3_PER_ML for name in SURFACES[:2])
        grid = np.array(bands["left_volume"])
        if not grid[0] <= left <= grid[-1]:
            raise InputError(
                f"frame {frame}: {left:.1f} mL; bands are of {grid[0]:g} to {grid[-1]:g} mL"
            )

        def at_left(name: str, grid: np.ndarray = grid, left: float = left) -> np.ndarray:
            table = np.array(bands[name])  # (levels, volumes, ...)
            above = np.clip(np.searchsorted(grid, left), 1, len(grid) - 1)
            share = (left - grid[above - 1]) / (grid[above] - grid[above - 1])
            return (1.0 - share) * table[:, above - 1] + share * table[:, above]

        low, middle, high = at_left("volume:rv_endocardium")
        case: Case = {
            "left_volume": left,
            "right_volume": {
                "measured": right, "low": low, "median": middle, "high": high,
                "inside": bool(low <= right <= high),
            },
        }  # fmt: skip
        for name in SURFACES:
            points, normals = np.array(bands["points"][name]), np.array(bands["normals"][name])
            extent = np.ptp(points, axis=0).max()
            ways = along_normals(points, normals, surfaces[name], 0.2 * extent)
            there = np.isfinite(ways)
            low, middle, high = (each[there] for each in at_left(f"surface:{name}"))
            inside = (low <= ways[there]) & (ways[there] <= high)
            case[name] = {
                "points": int(there.sum()),
                "inside": float(inside.mean()),
                "off_mm": float(np.sqrt(np.mean((ways[there] - middle) ** 2))),
                "moved_mm": float(np.sqrt(np.mean(ways[there] ** 2))),
                "width_mm": float(np.mean(high - low)),
            }
        found[frame] = case
    return found
