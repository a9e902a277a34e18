"""Stiffness off by orders of magnitude."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from studies.stability.solver.bodies import DOWN, bar, moduli
from studies.stability.solver.case import SINGLE_STEP, Case, case

import emulator as em


def _scaled(modulus: float, density: float) -> Case:
    load = em.loads.Gravity(density=density, direction=(0.0, 0.0, -1.0))
    return Case(bar(loads=(load,)), moduli(5.0 * modulus, 5.0 * modulus))


def _same_shape(modulus: float) -> Case:
    case = _scaled(modulus, modulus)

    def claim(u: np.ndarray) -> str:
        usual = _scaled(1.0, 1.0)
        wanted = np.asarray(em.Simulator(usual.scene).solve(usual.theta).displacement)
        gap = np.abs(u - wanted).max() / np.abs(wanted).max()
        return "" if gap < 1e-6 else f"differs from the unscaled solution by {gap:.1e}"

    return replace(case, claim=claim)


@case("stiffness")
def stiff_1e9_load_to_match() -> Case:
    return _same_shape(1e9)


@case("stiffness")
def soft_1e_9_load_to_match() -> Case:
    return _same_shape(1e-9)


@case("stiffness")
def stiff_1e9_usual_load() -> Case:
    case = _scaled(1e9, 1.0)

    def claim(u: np.ndarray) -> str:
        least = np.abs(u).max()
        return "" if 0.0 < least < 1e-6 else f"deflection {least:.1e} mm"

    return replace(case, claim=claim)


@case("stiffness")
def soft_1e_9_usual_load() -> Case:
    return _scaled(1e-9, 1.0)


@case("stiffness")
def soft_1e_3_usual_load() -> Case:
    return _scaled(1e-3, 1.0)


@case("stiffness")
def moduli_1e12_apart() -> Case:
    return Case(bar(loads=(DOWN,)), moduli(5.0, 5e12))


@case("stiffness")
def gravity_hundredfold() -> Case:
    return _scaled(1.0, 100.0)


@case("stiffness")
def gravity_hundredfold_single_step() -> Case:
    return replace(_scaled(1.0, 100.0), options=SINGLE_STEP)
