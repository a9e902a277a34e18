r"""Bands of points and of the force at motions of the pad beyond the data, and how many they hold.

What the model misses of a displacement at the point X and the motion a, the error of the model
``e(X, a)`` of :class:`calibrate.model_error.kinds.FieldError`, is known in the frames that are
data, so that at another motion it is a conditioned Gaussian field,

.. math:: e(a^*) \mid r \sim N\left(c^T C^{-1} r,\; v - c^T C^{-1} c\right),

with the residual r of each draw. A band is of all draws, of this error and of the noise.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.distance import cdist
from studies.common.kernels import matern32
from studies.common.output import Case
from studies.living_skin.skin import Measured, Skin, force_of, measured_of

import calibrate as cal
import emulator as em

LENGTH, ALONG = (
    5.0,
    2.0,
)  # mm in space and of the pad's motion, over which what is missed correlates
SD, FORCE_SD = 0.02, 0.004  # mm, N: what each number errs by itself
FORCE_SHARE = 0.05  # sd of the force's model error, per doubling of the largest motion of the data
_DRAWS, _EACH = 100, 20


@dataclass(frozen=True)
class Bands:
    """90 % bands at motions ``amounts`` and ``force_amounts``, mm.

    points : (n, 2) mm. low, high, mean : (a, n, 2) mm. force : (f, 3) N: low, mean, high.
    numbers : of the points in the table.
    """

    amounts: tuple[float, ...]
    force_amounts: tuple[float, ...]
    points: np.ndarray
    numbers: np.ndarray
    low: np.ndarray
    mean: np.ndarray
    high: np.ndarray
    force: np.ndarray

    def to_json(self) -> Case:
        """Plain JSON."""
        of = {n: np.asarray(getattr(self, n)).round(4).tolist() for n in ("low", "mean", "high")}
        return {
            "amounts_mm": list(self.amounts),
            "force_amounts_mm": list(self.force_amounts),
            "points_mm": self.points.tolist(),
            "numbers": self.numbers.tolist(),
            **of,
            "force_n": self.force.round(5).tolist(),
        }

    @classmethod
    def of_json(cls, case: Case) -> "Bands":
        """The bands of a case."""
        return cls(
            tuple(case["amounts_mm"]), tuple(case["force_amounts_mm"]),
            np.array(case["points_mm"]), np.array(case["numbers"]), np.array(case["low"]),
            np.array(case["mean"]), np.array(case["high"]), np.array(case["force_n"]),
        )  # fmt: skip

    def against(self, measured: Measured) -> Case:
        """How far measured points and forces are from the bands, where they are there."""
        inside, off, moved = [], [], []
        for k, amount in enumerate(self.amounts):
            frames = measured.field.frames
            motions = np.array([measured.amounts[frame] for frame in frames])
            if not motions.min() <= amount <= motions.max():
                continue
            order = np.argsort(motions)
            u = measured.field.displacement[order][:, self.numbers].reshape(len(frames), -1)
            at = np.array([np.interp(amount, motions[order], column) for column in u.T])
            at = at.reshape(-1, 2)
            inside.append((at >= self.low[k]) & (at <= self.high[k]))
            off.append(at - self.mean[k])
            moved.append(at)
        forces = []
        for k, amount in enumerate(self.force_amounts):
            low, mean, high = self.force[k].tolist()
            forces.append({"amount": amount, "low": low, "mean": mean, "high": high})
            try:
                forces[-1]["measured"] = measured.force(amount)
            except (TypeError, np.linalg.LinAlgError):  # beyond the table
                continue
        return {
            "inside": [float(np.mean(each)) for each in inside],
            "rms_mm": float(np.sqrt(np.mean(np.square(off)))) if off else None,
            "motion_mm": float(np.sqrt(np.mean(np.square(moved)))) if off else None,
            "forces": forces,
        }


def bands_of(
    found: cal.Posterior, scene: em.Scene, forward: em.ForwardMap, measured: Measured,
    frames: tuple[str, ...], amounts: tuple[float, ...], force_amounts: tuple[float, ...],
) -> Bands:  # fmt: skip
    """Bands given a posterior of ``frames``."""
    names, rng = scene.parameter_names, np.random.default_rng(0)
    pull = names.index("pull")
    seen = np.array([measured.amounts[frame] for frame in frames])
    part = cal.landmarks(
        scene,
        np.column_stack(
            [measured.field.points[measured.chosen], np.full(len(measured.chosen), _top(scene))]
        ),
    )
    of_points, of_pad = forward.at(part.nodes), force_of(scene, forward)

    @jax.jit
    def predicted(theta: jax.Array, motions: jax.Array) -> jax.Array:
        thetas = jnp.tile(theta, (len(motions), 1)).at[:, pull].set(motions)
        return part(jax.vmap(of_points)(thetas), thetas)[..., :2]

    @jax.jit
    def pulled(theta: jax.Array, motions: jax.Array) -> jax.Array:
        thetas = jnp.tile(theta, (len(motions), 1)).at[:, pull].set(motions)
        return jax.vmap(of_pad)(thetas)

    data = measured.field.only(frames, measured.chosen).displacement
    thetas = found.thetas(frames[0])
    rows = np.linspace(0, len(thetas) - 1, _DRAWS).astype(int)
    sizes = np.ravel(found.draws()["field_sd"])[rows]
    X, later = measured.field.points[measured.chosen], np.array(amounts)
    in_space = np.asarray(matern32(jnp.asarray(cdist(X, X, "sqeuclidean")) / LENGTH**2))

    def along(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        distance = (a[:, None] - b[None]) / ALONG
        return np.asarray(matern32(jnp.asarray(distance**2))) * np.outer(a, b) / seen.max() ** 2

    known, crossed, own = along(seen, seen), along(later, seen), along(later, later)
    samples, forces = list[np.ndarray](), list[np.ndarray]()
    growth = 1.0 + np.maximum(np.array(force_amounts) / seen.max() - 1.0, 0.0)
    for row, size in zip(rows, sizes, strict=True):
        theta = thetas[row]
        residual = data - np.asarray(predicted(theta, jnp.asarray(seen)))
        C = size**2 * np.kron(known, in_space) + SD**2 * np.eye(len(seen) * len(X))
        c = size**2 * np.kron(crossed, in_space)
        solved = np.linalg.solve(C, c.T)
        mean = solved.T @ np.nan_to_num(residual).reshape(len(C), 2)
        spread = size**2 * np.repeat(np.diag(own), len(X)) - np.einsum("ij,ji->i", c, solved)
        sd = np.sqrt(np.maximum(spread, 0.0) + SD**2)[:, None]
        at = np.asarray(predicted(theta, jnp.asarray(later))).reshape(-1, 2) + mean
        samples.append(at + sd * rng.normal(size=(_EACH, *at.shape)))
        force = np.asarray(pulled(theta, jnp.asarray(force_amounts)))
        error = np.hypot(FORCE_SD, FORCE_SHARE * np.abs(force) * np.log2(2.0 * growth))
        forces.append(force + error * rng.normal(size=(_EACH, len(force))))
    every, pulls = np.concatenate(samples), np.concatenate(forces)
    shape = (len(later), len(X), 2)
    low, mean, high = (
        *(np.quantile(every, q, axis=0).reshape(shape) for q in (0.05, 0.5)),
        np.quantile(every, 0.95, axis=0).reshape(shape),
    )
    force_bands = np.quantile(pulls, [0.05, 0.5, 0.95], axis=0).T
    return Bands(
        tuple(amounts), tuple(force_amounts), X, measured.chosen, low, mean, high, force_bands
    )


def judged(skin: Skin, case: Case, folder: Path) -> Case:
    """The bands against tables that reach further."""
    bands = Bands.of_json(case)
    found: Case = bands.against(measured_of(skin, folder, len(bands.points)))
    return found


def _top(scene: em.Scene) -> Any:
    return scene.mesh.nodes[:, 2].max()
