"""What the network's posterior of an unseen ventricle is off by, beside a certified one."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from studies.any_ventricle.judge import NETWORK, references
from studies.common.twins import twin

import calibrate as cal
import emulator as em

OBSERVE, NOISE = "landmarks:24+volume", {"displacement": 1.0, "volume": 3.0}  # mm, mL
DRAWS = 40


def first_posterior(make: Callable[[], em.Scene], number: int, tests: int, kept: Path) -> Any:
    """The posterior of FEM's data at one theta by the network, and by a series that FEM certifies.

    The means' moves are in sd of the latter.
    """
    scene = make()
    known, _ = references(scene, number, tests, (False, False), kept)
    theta, u = known.theta[0], known.displacement[0]
    observe, noises, data = twin(scene, OBSERVE, NOISE, theta, u, number)
    simulator = em.Simulator(scene)
    began = time.perf_counter()
    first = cal.sample(cal.model(em.load(NETWORK, scene).cache(), observe, noises), data)
    seconds = time.perf_counter() - began
    series = em.Emulator(scene, taylor=em.expand(simulator, order=3))
    better = cal.sample(cal.model(series.cache(), observe, noises), data, predictions=False)
    certificate = cal.certify(better, simulator, draws=DRAWS, mesh=0)
    ours, theirs = first.summary(), better.summary()
    moves = {n: (ours[n]["mean"] - row["mean"]) / row["sd"] for n, row in theirs.items()}
    jax.clear_caches()
    return {
        "seconds_to_posterior": round(seconds, 1),
        "moved_sd": moves,
        "largest_move_sd": float(np.max(np.abs(list(moves.values())))),
        "certified": certificate.verdict,
        "reason": certificate.reason,
        "certified_move_sd": {n: f.value for n, f in certificate.evidence.draws.shift.items()},
    }
