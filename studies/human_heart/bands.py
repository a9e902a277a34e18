r"""Bands of frames given the left cavity's volume, and how many points of a frame they hold.

At a volume V of the left cavity the heart of each draw has the pressure at which it is that large;
the right pressure is the mean of all frames'. What mechanics misses of a surface, at points x,

.. math:: r_f(x) = b(x) + h_f\, g(x) + e_f(x), \qquad h_f = (V_f - V_0) / 15\,\text{mL},

is an error b of the imaged frame, a part that grows with the volume, and an error of each frame:
Gaussian fields of one correlation length, whose sds are the likeliest ones. Bands are of the field
at another volume, given all frames, and of the draws. A volume has the same model without places.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from studies.common.kernels import matern32
from studies.common.output import Case
from studies.human_heart.heart import IMAGED, LENGTH, SURFACES, surfaces_of

import calibrate as cal
import emulator as em

KEPT_APART = ("f017", "f019", "f021", "f023")
VOLUMES = np.arange(140.0, 186.0, 3.0)  # mL, of the left cavity
POINTS = 200  # of a surface
_PRESSURES, _DRAWS = 12, 240
_STEP = 15.0  # mL
_NORMAL, _STUDENT = 1.645, 2.13  # sds of a 90 % band; few volumes tell their own sd


class Seen(NamedTuple):
    """A frame: the volumes in mL of both cavities, and the way (d,) mm to each surface by name."""

    left: float
    right: float
    ways: dict[str, np.ndarray]


def seen_at(places: dict[str, tuple[np.ndarray, np.ndarray]], folder: Path, frame: str) -> Seen:
    """A frame along the normals of points; places (d, 3) and normals (d, 3) by surface."""
    surfaces = surfaces_of(folder, frame)
    left, right = (surfaces[name].volume / 1000.0 for name in SURFACES[:2])
    ways = {
        name: cal.fields.along_normals(
            points, normals, surfaces[name], 0.2 * np.ptp(points, axis=0).max()
        )
        for name, (points, normals) in places.items()
    }
    return Seen(left, right, ways)


def bands_of(
    found: cal.Posterior, scene: em.Scene, forward: em.ForwardMap, folder: Path,
    frames: tuple[str, ...], quick: bool,
) -> Case:  # fmt: skip
    """5, 50 and 95 % of normal distances and of the right volume, at each left volume.

    Distances are from the imaged frame, at points on its mesh. ``frames`` are those of ``found``.
    """
    count = 20 if quick else POINTS
    parts = {
        name: cal.surface_points(scene, name, cal.fields.spread_evenly(scene.mesh, name, count))
        for name in SURFACES
    }
    places = {name: (part.points, part.normals) for name, part in parts.items()}
    known = [seen_at(places, folder, frame) for frame in frames]
    start = seen_at({}, folder, IMAGED).left
    volumes = np.concatenate([VOLUMES, [frame.left for frame in known]])
    means, sds, reached = _by_mechanics(found, scene, forward, parts, volumes)
    h = (volumes - start) / _STEP
    grid, own = slice(0, len(VOLUMES)), slice(len(VOLUMES), None)
    bands: Case = {
        "left_volume": VOLUMES.tolist(),
        "points": {name: points.round(4).tolist() for name, (points, _) in places.items()},
        "normals": {name: normals.round(6).tolist() for name, (_, normals) in places.items()},
        "share_of_draws_that_reach_it": reached[grid].tolist(),
        "sds": {},
    }
    for name, (points, _) in places.items():
        key = f"surface:{name}"
        missed = np.array([frame.ways[name] for frame in known]) - means[key][own]
        K = np.asarray(matern32(cdist(points, points, "sqeuclidean") / LENGTH**2))
        mean, sd, told = _field(_filled(missed, points), K, h[own], h[grid])
        bands["sds"][name] = told
        bands[key] = _levels(means[key][grid] + mean, np.hypot(sd, sds[key][grid]), _NORMAL)
    key = f"volume:{SURFACES[1]}"
    missed = np.array([frame.right for frame in known]) - means[key][own]
    mean, sd, told = _field(missed[:, None], np.ones((1, 1)), h[own], h[grid])
    bands["sds"][key] = told
    middle, width = means[key][grid] + mean[:, 0], np.hypot(sd[:, 0], sds[key][grid])
    bands[key] = _levels(middle, width, _STUDENT)
    return bands


def _levels(middle: np.ndarray, sd: np.ndarray, factor: float) -> list:
    return np.stack([middle - factor * sd, middle, middle + factor * sd]).round(2).tolist()


def _by_mechanics(
    found: cal.Posterior, scene: em.Scene, forward: em.ForwardMap, parts: dict[str, Any],
    volumes: np.ndarray,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], np.ndarray]:  # fmt: skip
    """Means and sds over draws of all that is predicted, and the share of draws that come so far.

    Arrays (v, ...) by observation, at each left volume (v,).
    """
    observe = cal.Observations({
        **{f"surface:{name}": part for name, part in parts.items()},
        **{f"volume:{name}": cal.CavityVolume(scene, name) for name in SURFACES[:2]},
    })  # fmt: skip
    at = forward.at(observe.nodes)
    program = jax.jit(jax.vmap(lambda theta: observe(at(theta)[None], theta[None])))
    states = [found.thetas(state) for state in found.model.states.states]
    rows = np.linspace(0, len(states[0]) - 1, _DRAWS).astype(int)
    names = scene.parameter_names
    right = names.index("right_pressure")
    thetas = states[0][rows].at[:, right].set(float(np.mean([s[:, right].mean() for s in states])))
    column = names.index("pressure")
    low, high = scene.parameters[column].low, scene.parameters[column].high
    values = [
        program(thetas.at[:, column].set(pressure))
        for pressure in np.linspace(low, high, _PRESSURES)
    ]
    by_name = {name: np.stack([np.asarray(v[name]) for v in values]) for name in values[0]}
    left = by_name.pop(f"volume:{SURFACES[0]}")
    reached = [((left.min(axis=0) <= v) & (v <= left.max(axis=0))).mean() for v in volumes]
    at_volume = {
        name: np.stack([_at(v, left, value) for v in volumes]) for name, value in by_name.items()
    }
    means = {name: value.mean(axis=1) for name, value in at_volume.items()}
    return means, {n: v.std(axis=1) for n, v in at_volume.items()}, np.array(reached)


def _filled(missed: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return errors (f, d) mm; where a frame does not reach, that of the nearest point."""
    filled = missed.copy()
    for row in filled:
        there = np.isfinite(row)
        nearest = cKDTree(points[there]).query(points[~there])[1]
        row[~there] = row[there][nearest]
    return filled


def _field(
    missed: np.ndarray, K: np.ndarray, h: np.ndarray, h_new: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Case]:
    """Mean and sd (v, d) of what is missed at ``h_new`` (v,), given ``missed`` (f, d) at h (f,).

    Also the sds: of what grows, by 15 mL, and of a frame, correlated and independent.
    """
    scale, Q = np.linalg.eigh(K)
    scale, r, one = np.maximum(scale, 0.0), missed @ Q, np.ones(len(h))

    def parts(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Covariance (d, f, f) of frames by mode, and with new ones (d, v, f)."""
        grows, frame, own = np.exp(2.0 * logs)
        shared = grows * np.outer(h, h) + frame * (np.outer(one, one) + np.eye(len(h)))
        new = grows * np.outer(h_new, h) + frame
        C = scale[:, None, None] * shared + own * np.eye(len(h))
        return C, scale[:, None, None] * new, own

    def misfit(logs: np.ndarray) -> float:
        C, _, _ = parts(logs)
        half = 0.5 * np.einsum("fk,kfg,gk->", r, np.linalg.inv(C), r)
        # Half-normal priors of an sd of some mm, or mL: few frames tell little of sds.
        return float(half + 0.5 * np.linalg.slogdet(C)[1].sum() + np.exp(2.0 * logs).sum() / 200.0)

    logs = minimize(misfit, np.zeros(3), method="Nelder-Mead", options={"maxiter": 2000}).x
    C, new, own = parts(logs)
    grows, frame, _ = np.exp(2.0 * logs)
    inverse = np.linalg.inv(C)
    mean = np.einsum("kvf,kfg,gk->vk", new, inverse, r) @ Q.T
    prior = scale[:, None] * (grows * h_new**2 + 2.0 * frame)
    variance = prior - np.einsum("kvf,kfg,kvg->kv", new, inverse, new)
    sd = np.sqrt(np.einsum("dk,kv->vd", Q**2, variance) + own)
    return mean, sd, dict(zip(("grows", "frame", "own"), np.exp(logs).tolist(), strict=True))


def _at(volume: float, left: np.ndarray, value: np.ndarray) -> np.ndarray:
    """A value (k, s, ...) at k pressures, where the left volume (k, s) has this value."""
    found = np.empty(value.shape[1:])
    for s in range(left.shape[1]):
        above = np.clip(np.searchsorted(left[:, s], volume), 1, len(left) - 1)
        share = (volume - left[above - 1, s]) / (left[above, s] - left[above - 1, s])
        found[s] = value[above - 1, s] + share * (value[above, s] - value[above - 1, s])
    return found


def judged(bands: Case, data: Path, frames: tuple[str, ...]) -> Case:
    """How much of each frame lies in its bands, given its left volume alone."""
    places = {
        name: (np.array(bands["points"][name]), np.array(bands["normals"][name]))
        for name in SURFACES
    }
    grid, found = np.array(bands["left_volume"]), Case()
    for frame in frames:
        left, right, ways = seen_at(places, data, frame)
        if not grid[0] <= left <= grid[-1]:
            raise em.InputError(
                f"frame {frame}: {left:.1f} mL; bands are of {grid[0]:g} to {grid[-1]:g} mL"
            )
        above = np.clip(np.searchsorted(grid, left), 1, len(grid) - 1)
        share = (left - grid[above - 1]) / (grid[above] - grid[above - 1])
        tables = {key: np.array(bands[key]) for key in bands if key.partition(":")[2]}
        at = {k: (1.0 - share) * t[:, above - 1] + share * t[:, above] for k, t in tables.items()}
        low, middle, high = at[f"volume:{SURFACES[1]}"]
        case: Case = {
            "left_volume": left,
            "right_volume": {
                "measured": right, "low": low, "median": middle, "high": high,
                "inside": bool(low <= right <= high),
            },
        }  # fmt: skip
        for name, way in ways.items():
            there = np.isfinite(way)
            way, (low, middle, high) = way[there], at[f"surface:{name}"][:, there]
            case[name] = {
                "points": int(there.sum()),
                "inside": float(((low <= way) & (way <= high)).mean()),
                "off_mm": float(np.sqrt(np.mean((way - middle) ** 2))),
                "moved_mm": float(np.sqrt(np.mean(way**2))),
                "width_mm": float(np.mean(high - low)),
            }
        found[frame] = case
    return found
