"""Experiments like these, made of the model: does the posterior cover what they were made of?

A twin has a heart's geometry, amounts and emulator. Its forces are FEM's at a test, a draw of the
heart's posterior that the emulator was not fitted to, off by as much as that draw says and with the
cell's noise. Shares below the truth are uniform in the posterior of the heart's forces *and* its
twin's, since these are two experiments of one prior, p(theta | heart) (Saeilynoja et al. 2025,
posterior SBC); of the twin's alone they are not, where the prior tells anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from studies.common.output import Case, cores
from studies.sheep_myocardium.campaign import Campaign
from studies.sheep_myocardium.experiment import MODES, Heart
from studies.sheep_myocardium.held_out import replicated
from studies.sheep_myocardium.inference import ORTHOTROPIC, parameters, sample

_OUTER = (0.05, 0.95)
_A_HEART = 6


def twin(found: Campaign, test: int, rng: np.random.Generator) -> Heart:
    """The heart with forces as they would be measured of a test."""
    heart, curves = found.heart, {}
    omega = found.explored.draws["omega"][found.tested[test]]
    forces = found.by_fem[test] * np.asarray(found.cubes.finer).reshape(len(MODES), -1)
    for mode, force in zip(MODES, forces, strict=True):
        curve = heart.curves[mode]
        z = rng.normal(size=(1, len(force)))
        made = replicated(curve.amount, force[None], np.array([omega]), z)[0]
        curves[mode] = replace(curve, force=made)
    return replace(heart, curves=curves)


def ranks(found: Campaign, seed: int, steps: int) -> list[dict[str, float]]:
    """Of some tests, shares of a twin's posterior below the truth, by parameter.

    A heart's twins have errors of their own: those of two hearts are not alike.
    """
    rng = np.random.default_rng([seed, *found.heart.name.encode()])
    sound = np.flatnonzero(np.isfinite(found.by_fem).all(axis=(1, 2)))[:_A_HEART]
    made = {test: twin(found, test, rng) for test in sound}

    def below(test: int) -> dict[str, float]:
        how = {"known": found.explored.modes, "steps": steps, "chains": 1}
        posterior = sample(found.heart, found.cubes, seed + test, twin=made[test], **how)
        row = found.tested[test]
        names = parameters(ORTHOTROPIC)
        told = {n: _below(posterior.theta(n), found.explored.theta(n)[row]) for n in names}
        omega = found.explored.draws["omega"][row]
        return told | {"omega": _below(posterior.draws["omega"], omega)}

    with ThreadPoolExecutor(cores()) as pool:
        return list(pool.map(below, made))


def _below(draws: np.ndarray, truth: float) -> float:
    return float(np.mean(draws < truth))


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
