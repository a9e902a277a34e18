"""Bad starts."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np
from studies.stability.solver.bodies import DOWN, bar, moduli, twist
from studies.stability.solver.case import SEED, Case, case, simulator_of

import emulator as em


@cache
def cantilever() -> em.Scene:
    return bar(loads=(DOWN,))


@cache
def cantilever_solution() -> np.ndarray:
    return np.asarray(
        simulator_of(cantilever(), em.fem.NewtonOptions())
        .solve(moduli())
        .require_converged()
        .displacement
    )


def as_from_rest(u: np.ndarray) -> str:
    gap = np.abs(u - cantilever_solution()).max()
    return "" if gap < 1e-6 else f"another answer than from rest, {gap:.1e} mm away"


def _started(start: Any) -> Case:
    return Case(cantilever(), moduli(), start, claim=as_from_rest)


@case("starts")
def start_inverted() -> Case:
    return _started(-2.0 * cantilever().mesh.nodes)


@case("starts")
def start_noise_a_tenth_of_an_element() -> Case:
    rng = np.random.default_rng(SEED)
    return _started(0.5 * rng.normal(size=cantilever().mesh.nodes.shape))


@case("starts")
def start_noise_of_an_element() -> Case:
    rng = np.random.default_rng(SEED)
    return _started(5.0 * rng.normal(size=cantilever().mesh.nodes.shape))


@case("starts")
def start_noise_of_a_metre() -> Case:
    rng = np.random.default_rng(SEED)
    return _started(1e3 * rng.normal(size=cantilever().mesh.nodes.shape))


@case("starts")
def start_turned_round() -> Case:
    """The body turned by half a turn about its axis, away from its support."""
    scene = cantilever()
    return _started(twist(scene.mesh.nodes, np.array([0.0, 5.0, 5.0]), 180.0))


@case("starts")
def start_stretched_a_hundredfold() -> Case:
    return _started(cantilever().mesh.nodes * [99.0, 0.0, 0.0])


@case("starts")
def start_nearly_flat() -> Case:
    return _started(cantilever().mesh.nodes * [-0.999, 0.0, 0.0])


@case("starts")
def start_opposite_load() -> Case:
    up = replace(cantilever(), loads=(em.loads.Gravity(direction=(0.0, 0.0, 1.0)),))
    return _started(em.Simulator(up).solve(moduli()).displacement)


@case("starts")
def start_opposite_corner() -> Case:
    return _started(
        simulator_of(cantilever(), em.fem.NewtonOptions()).solve(moduli(1.0, 1.0)).displacement
    )


@case("starts")
def start_ten_times_the_load() -> Case:
    heavy = replace(cantilever(), loads=(em.loads.Gravity(10.0),))
    return _started(em.Simulator(heavy).solve(moduli()).displacement)


@case("starts")
def start_of_NaN() -> Case:
    return _started(np.full(cantilever().mesh.nodes.shape, np.nan))


@case("starts")
def start_of_1e300() -> Case:
    return _started(np.full(cantilever().mesh.nodes.shape, 1e300))


@case("starts")
def start_in_float32() -> Case:
    return _started(jnp.asarray(cantilever_solution(), jnp.float32))


@case("starts")
def start_of_integers() -> Case:
    return _started(np.zeros(cantilever().mesh.nodes.shape, dtype=int))


@case("starts")
def start_of_the_wrong_shape() -> Case:
    return _started(np.zeros(3))
