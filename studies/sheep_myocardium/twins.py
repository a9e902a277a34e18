"""Experiments like these, made of the model: does the posterior cover what they were made of?

A twin has a heart's geometry, amounts and emulator. Its forces are FEM's at a test, which the
emulator was not fitted to, off by as much as the heart's and with the cell's noise. Its posterior
is sought as the heart's was, on the mesh that made it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from studies.common.output import Case
from studies.sheep_myocardium import cube
from studies.sheep_myocardium.campaign import Campaign
from studies.sheep_myocardium.experiment import MODES, Heart
from studies.sheep_myocardium.held_out import replicated
from studies.sheep_myocardium.inference import ORTHOTROPIC, parameters, sample

from emulator.machine import cores

_OUTER = (0.05, 0.95)
_A_HEART = 6


def twin(found: Campaign, test: int, rng: np.random.Generator) -> Heart:
    """The heart with forces as they would be measured of a test."""
    heart, curves = found.heart, {}
    for mode, force in zip(MODES, found.by_fem[test], strict=True):
        curve = heart.curves[mode]
        made = replicated(curve.amount, force[None], np.array([found.omega]), rng)[0]
        curves[mode] = replace(curve, force=made)
    return replace(heart, curves=curves)


def ranks(found: Campaign, seed: int, steps: int) -> list[dict[str, float]]:
    """Of some tests, shares of a twin's posterior below the truth, by parameter.

    A heart's twins have errors of their own: those of two hearts are not alike.
    """
    rng = np.random.default_rng([seed, *found.heart.name.encode()])
    made = [twin(found, test, rng) for test in range(min(_A_HEART, len(found.tests[0].x)))]

    def below(test: int) -> dict[str, float]:
        how = {"known": found.explored.modes, "steps": steps, "chains": 1}
        posterior = sample(made[test], found.coarse, seed + test, **how)
        at = 0.5 * (found.tests[0].x[test, : len(cube.MATERIAL)] + 1.0)
        truth = {
            p.name: float(p.from_unit(jnp.asarray(v)))
            for p, v in zip(cube.MATERIAL, at, strict=True)
        }
        told = {n: float(np.mean(posterior.theta(n) < truth[n])) for n in parameters(ORTHOTROPIC)}
        return told | {"omega": float(np.mean(posterior.draws["omega"] < found.omega))}

    with ThreadPoolExecutor(cores()) as pool:
        return list(pool.map(below, range(len(made))))


def covered(each: Sequence[dict[str, float]]) -> Case:
    """Twins whose 90 % intervals hold the truth, by parameter and in all."""
    low, high = _OUTER
    inside = {n: sum(low <= one[n] <= high for one in each) for n in each[0]}
    return {
        "twins": len(each),
        "covered": inside,
        "share": sum(inside.values()) / (len(each) * len(inside)),
        "below": [{n: round(v, 4) for n, v in one.items()} for one in each],
    }
