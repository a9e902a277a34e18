"""Shipped emulators in float32, outside their box, and at theta that is no number."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from studies.stability.emulation.check import Ended, add

import emulator as em

NAMES = ("once_clamped_beam", "twisting_cube", "liver", "left_ventricle")
SHIPPED = (*NAMES, *(f"{name}_series" for name in NAMES))
STEPS_OUT = {"a_tenth": 0.1, "half": 0.5, "twice": 2.0}  # of the box's sides
FACTOR = 3.0
ROUND_OFF = 1e-3  # of the largest displacement, in float32


@cache
def shipped(name: str) -> em.Emulator:
    return em.load(name)


def positions(dimension: int, out: float) -> np.ndarray:
    """Corners of the unit box moved outwards by ``out``: the two ends and two at random."""
    rng = np.random.default_rng(3)
    corners = np.array(
        [np.zeros(dimension), np.ones(dimension), *rng.integers(0, 2, (2, dimension))]
    )
    return 0.5 + (corners - 0.5) * (1.0 + 2.0 * out)


def _in_float32(name: str) -> Ended:
    forward, scene = shipped(name).cache(), shipped(name).scene
    thetas = np.asarray(scene.from_unit(jnp.asarray(positions(len(scene.parameters), 0.0))))
    wide = np.stack([np.asarray(forward(jnp.asarray(theta))) for theta in thetas])
    with jax.enable_x64(False):
        narrow = np.stack([np.asarray(forward(jnp.asarray(t, jnp.float32))) for t in thetas])
    if narrow.dtype != np.float32:
        return Ended("PREDICTED", f"computed in {narrow.dtype}")
    gap = float(np.abs(narrow - wide).max() / np.abs(wide).max())
    if not gap < ROUND_OFF:
        return Ended("PREDICTED", f"differs by {gap:.1e} of the largest displacement")
    return Ended("PREDICTED", note=f"differs by {gap:.1e} of the largest displacement")


def _outside(name: str, out: float) -> Ended:
    """Outside, a map says so, and the error bar is right or is not trusted."""
    forward, scene = shipped(name).cache(), shipped(name).scene
    simulator, ratios, failed = em.Simulator(scene), [], 0
    bar = em.ErrorBar(forward, simulator)
    for x in positions(len(scene.parameters), out):
        theta = scene.from_unit(jnp.asarray(x))
        if bool(forward.evaluate(theta).valid):
            return Ended("PREDICTED", "the map calls a theta outside its box valid")
        estimate = bar(theta)
        if not all(np.isfinite(np.asarray(value)).all() for value in estimate if _numbers(value)):
            return Ended("OUTSIDE", "the error bar is not finite")
        solution = simulator.solve(theta)
        if not bool(estimate.valid) or not bool(solution.converged):
            failed += 1
            continue
        u = np.asarray(forward(theta)) - np.asarray(solution.displacement)
        ratios.append(float(estimate.median) / float(np.median(np.linalg.norm(u, axis=1))))
    wrong = [ratio for ratio in ratios if not 1.0 / FACTOR < ratio < FACTOR]
    if wrong:
        return Ended("OUTSIDE", f"error bar {wrong[0]:.2g} times the error")
    return Ended(
        "OUTSIDE", note=f"error bar over error {np.round(ratios, 2)}, {failed} not trusted"
    )


def _numbers(value: object) -> bool:
    return hasattr(value, "dtype") and np.issubdtype(value.dtype, np.floating)


def _no_number(name: str) -> Ended:
    forward, scene = shipped(name).cache(), shipped(name).scene
    for bad in (np.nan, np.inf):
        if bool(forward.evaluate(jnp.full(len(scene.parameters), bad)).valid):
            return Ended("PREDICTED", f"theta of {bad} is called valid")
    return Ended("OUTSIDE")


for _name in SHIPPED:
    add("cached maps in float32", f"float32_{_name}", partial(_in_float32, _name))
    add("error bars outside", f"no_number_{_name}", partial(_no_number, _name))
    for _label, _out in STEPS_OUT.items():
        add("error bars outside", f"outside_by_{_label}_{_name}", partial(_outside, _name, _out))
