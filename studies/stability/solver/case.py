"""What a hard case for the simulator is, and its answer."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import jax
import numpy as np
from studies.stability.judge import is_stable, judge

import emulator as em

SEED = 7
SINGLE_STEP = em.fem.NewtonOptions(min_increment=1.0)


@dataclass(frozen=True)
class Case:
    """One call of the simulator.

    scene, theta : what is simulated, where.
    start : (n, 3) mm, or from rest.
    options : controls of the solver.
    inside_jit : whether the call is made inside ``jit``, where nothing can be caught.
    claim : what must hold for a converged answer; returns what is wrong, or an empty string.
    """

    scene: em.Scene
    theta: Any
    start: Any = None
    options: em.fem.NewtonOptions = field(default_factory=em.fem.NewtonOptions)
    inside_jit: bool = False
    claim: Callable[[np.ndarray], str] = lambda _: ""

    def examine(self) -> dict[str, Any]:
        """Solve, and judge the answer."""
        began = time.perf_counter()
        simulator, solution = _solve(self)
        return {
            "time_s": time.perf_counter() - began,
            "status": em.fem.Status(int(solution.status)).name,
            "iterations": int(solution.iterations),
            "load_reached": float(solution.load_reached),
            **_verdict(self, simulator, solution),
        }


Maker = Callable[[], Case]
CASES: dict[str, tuple[str, Maker]] = {}
"""Name -> (family, function)."""


def case(family: str) -> Callable[[Maker], Maker]:
    """Register a function under its name."""

    def register(maker: Maker) -> Maker:
        CASES[maker.__name__] = (family, maker)
        return maker

    return register


def near(what: str, value: float, wanted: float, tolerance: float) -> str:
    """Empty when ``value`` is ``wanted`` within a relative ``tolerance``."""
    fine = abs(value - wanted) <= tolerance * abs(wanted)
    return "" if fine else f"{what} is {value:.6g}, should be {wanted:.6g}"


@cache  # cases share scenes, and each is compiled once
def simulator_of(scene: em.Scene, options: em.fem.NewtonOptions) -> em.Simulator:
    return em.Simulator(scene, options)


def _solve(found: Case) -> tuple[em.Simulator, Any]:
    """The simulator's answer, computed when this returns."""
    simulator = simulator_of(found.scene, found.options)
    call = jax.jit(simulator.solve) if found.inside_jit else simulator.solve
    solution = call(found.theta, found.start)
    return simulator, jax.block_until_ready(solution)


def _verdict(found: Case, simulator: em.Simulator, solution: Any) -> dict[str, Any]:
    """Judge an answer by what its status claims."""
    u = np.asarray(solution.displacement)
    if not np.isfinite(u).all():
        return {"silent_wrong": True, "note": "displacement not finite"}
    if solution.status != em.fem.Status.CONVERGED:
        return {}
    claim = found.claim(u)
    try:
        judged = judge(found.scene, u, np.asarray(found.theta), claim)
        stable = is_stable(simulator, solution.displacement, np.asarray(found.theta))
    except Exception as error:  # an answer to a question that makes no sense
        return {"silent_wrong": True, "note": claim or f"cannot be judged: {error}"}
    return {
        "silent_wrong": bool(judged.wrong),
        "residual": judged.residual,
        "independent": judged.independent,
        "smallest_J": judged.smallest_J,
        "stable": stable,
        "note": judged.wrong,
    }
