"""Posteriors that samplers find hard, each judged by quadrature on a grid.

A map of two parameters moves every node by ``g(x)`` along z, x the position in the unit box, where
the prior is uniform. So the posterior's moments are sums over a grid, computed here with NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.stability.emulation.check import Ended, add

import calibrate as cal
import emulator as em

SAMPLERS = ("nuts", "blackjax_nuts", "smc", "laplace")
SHIFT, LOG_SD = 0.25, np.log(1.25)  # of moments, in posterior sd
GRID = 1500


@dataclass(frozen=True)
class Target:
    """A posterior: ``g`` of x (2, ...) in mm, datum and noise in mm.

    valid : where the map has an answer. told : whether only a warning is right, whatever is drawn.
    """

    g: Callable[[Any], Any]
    datum: float
    sd: float
    valid: Callable[[Any], Any] = lambda x: x[0] > -1.0
    told: bool = False


TARGETS = {
    # Neal's funnel: the width of the one is the exponential of the other.
    "funnel": Target(lambda x: (x[0] - 0.5) * jnp.exp(8.0 * (x[1] - 0.5)), 0.0, 0.05),
    # A curved ridge that leaves the box at two sides.
    "ridge_cut_by_the_box": Target(lambda x: x[0] * x[1] + 0.5 * x[0] ** 2, 0.4, 0.01),
    # The posterior's area is 1e-6 of the prior's.
    "tight_noise": Target(lambda x: x[0] + 0.3 * x[1], 0.5, 1e-4),
    "two_modes": Target(lambda x: (x[0] - 0.5) ** 2, 0.09, 0.01),
    "nothing_learned": Target(lambda x: 0.0 * x[0], 0.0, 1.0),
    "half_the_box_has_no_answer": Target(lambda x: x[0] + x[1], 1.0, 0.1, lambda x: x[0] < 0.5),
    # 300 sd beyond all that the model can produce.
    "data_the_model_cannot_produce": Target(lambda x: x[0] + x[1], 5.0, 0.01, told=True),
}


@cache
def scene() -> em.Scene:
    return em.scenes.once_clamped_beam((2, 1, 1), order=1)


@dataclass(frozen=True, eq=False)
class Toy:
    """The forward map of a target."""

    name: str
    nodes: np.ndarray
    kind = label = "toy"

    @property
    def scene(self) -> em.Scene:
        return scene()

    @property
    def fingerprint(self) -> str:
        return f"{self.kind} {self.name} {hash(self.nodes.tobytes())}"

    def __call__(self, theta: jax.Array) -> jax.Array:
        moved = TARGETS[self.name].g(scene().to_unit(theta))
        return jnp.zeros((len(self.nodes), 3)).at[:, 2].set(moved)

    def evaluate(self, theta: jax.Array) -> em.Prediction:
        x = scene().to_unit(theta)
        inside = jnp.all((x >= 0.0) & (x <= 1.0))
        return em.Prediction(self(theta), inside & TARGETS[self.name].valid(x))

    def at(self, nodes: np.ndarray) -> Toy:
        return replace(self, nodes=np.asarray(nodes))


def exact(target: Target) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd (2,) of x by the midpoint rule, again where the posterior is small."""
    low, high = np.zeros(2), np.ones(2)
    for _ in range(3):
        x = low[:, None] + (high - low)[:, None] * (np.arange(GRID) + 0.5) / GRID
        both = np.stack(np.meshgrid(*x, indexing="ij"))
        log_p = -0.5 * ((np.asarray(target.g(both)) - target.datum) / target.sd) ** 2
        log_p = np.where(np.asarray(target.valid(both)), log_p, -np.inf)
        p = np.exp(log_p - log_p.max())
        p /= p.sum()
        mean = np.array([(p * each).sum() for each in both])
        sd = np.sqrt([(p * (each - m) ** 2).sum() for each, m in zip(both, mean, strict=True)])
        kept = [np.flatnonzero(p.sum(axis=1 - k) > 1e-12) for k in range(2)]
        low, high = (
            np.array([each[rows[side]] for each, rows in zip(x, kept, strict=True)])
            for side in (0, -1)
        )
        low, high = low - 1.0 / GRID, high + 1.0 / GRID
        low, high = np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0)
    return mean, sd


def _sampled(name: str, sampler: str) -> Ended:
    target, forward = TARGETS[name], Toy(name, np.arange(scene().node_count))
    tip = int(np.argmax(scene().mesh.nodes[:, 0]))
    observe = cal.nodal_displacements(scene(), np.array([tip]))
    model = cal.model(forward, observe, cal.GaussianNoise(target.sd), check_scale=False)
    data = np.array([[0.0, 0.0, target.datum]])
    options = cal.samplers.SAMPLERS[sampler].options()
    posterior = cal.sample(model, data, sampler=sampler, options=options, seed=5)
    told = posterior.warnings()
    if target.told:
        fit = "" if told else "data that the model cannot produce, without a word"
        return Ended("WARNED", fit, "; ".join(told)[:150])
    draws = np.stack([posterior.draws()[n] for n in scene().parameter_names], axis=-1)
    x = np.asarray(scene().to_unit(jnp.asarray(draws)))
    if not np.isfinite(x).all():
        return Ended("AGREES", "a draw is not finite")
    mean, sd = exact(target)
    shift = (np.abs(x.mean(axis=0) - mean) / sd).max()
    change = np.abs(np.log(x.std(axis=0) / sd)).max()
    found = f"shift {shift:.2f} sd, sd ratio {np.exp(change):.2f}"
    if shift < SHIFT and change < LOG_SD:
        return Ended("AGREES", note="; ".join([found, *told])[:150])
    if told:
        return Ended("WARNED", note="; ".join([found, *told])[:150])
    return Ended("AGREES", f"{found}, without a word")


for _name in TARGETS:
    for _sampler in SAMPLERS:
        add("samplers", f"{_sampler}_{_name}", partial(_sampled, _name, _sampler))
