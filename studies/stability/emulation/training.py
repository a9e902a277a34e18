"""Training on the energy from zero: rates, batches, exponents.

A network that is poor is no wrong answer; one that is poor while its error bar says otherwise is.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache, partial

import numpy as np
from studies.stability.emulation.check import Ended, add

import emulator as em

FAMILY = "training"
STEPS, TESTS = 60, 4
FACTOR = 3.0  # an error bar is right within it


@cache
def ventricle(exponent: float) -> em.Scene:
    """A coarse ventricle, its exponents ``b`` and ``b_f`` times ``exponent``."""
    scene = em.scenes.left_ventricle(4, 8, 1, order=1)
    grown = {"b", "b_f"}
    stiffer = tuple(
        replace(p, low=exponent * p.low, high=exponent * p.high) if p.name in grown else p
        for p in scene.parameters
    )
    return replace(scene, parameters=stiffer, origin={} if exponent != 1.0 else scene.origin)


def _trained(rate: float, batch: int, exponent: float, name: str) -> Ended:
    plan = replace(em.recipe(name), learning_rate=rate, batch=batch, steps=STEPS)
    with tempfile.TemporaryDirectory() as folder:
        return judge(em.train(ventricle(exponent), plan, folder))


def judge(found: em.Emulator) -> Ended:
    """Predictions are finite, and the error bar knows how poor they are."""
    scene, forward = found.scene, found.cache()
    simulator = em.Simulator(scene)
    thetas = em.fem.sobol(scene, TESTS, 11)
    predicted = np.stack([np.asarray(forward(theta)) for theta in thetas])
    if not np.isfinite(predicted).all():
        return Ended("TRAINED", "the trained emulator's displacement is not finite")
    bar, ratios, flagged = em.ErrorBar(forward, simulator), [], 0
    for theta, u in zip(thetas, predicted, strict=True):
        exact = np.asarray(simulator.solve(theta).require_converged().displacement)
        true = float(np.median(np.linalg.norm(u - exact, axis=1)))
        estimate = bar(theta)
        flagged += not bool(estimate.valid)
        if bool(estimate.valid):
            ratios.append(float(estimate.median) / true)
    wrong = [ratio for ratio in ratios if not 1.0 / FACTOR < ratio < FACTOR]
    note = f"loss {found.record['final_loss']:.3g}, error bar over error {np.round(ratios, 2)}"
    if wrong:
        return Ended("TRAINED", f"error bar {wrong[0]:.2g} times the error")
    return Ended("TRAINED", note=f"{note}, {flagged} of {TESTS} not trusted")


_DEFAULT = {"rate": 1e-3, "batch": 1, "exponent": 1.0, "name": "paper"}
for _name, _other in {
    "rate_1e_6": {"rate": 1e-6},
    "rate_1e_3": {},
    "rate_1": {"rate": 1.0},
    "rate_1e6": {"rate": 1e6},
    "batch_64": {"batch": 64},
    "exponents_threefold": {"exponent": 3.0},
    "exponents_tenfold": {"exponent": 10.0},
}.items():
    add(FAMILY, f"training_{_name}", partial(_trained, **(_DEFAULT | _other)))
add(FAMILY, "training_rate_NaN", partial(_trained, **(_DEFAULT | {"rate": float("nan")})))
add(FAMILY, "training_rate_negative", partial(_trained, **(_DEFAULT | {"rate": -1e-3})))
