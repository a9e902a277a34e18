"""Bad theta."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from studies.stability.solver.bodies import DOWN, bar, moduli
from studies.stability.solver.case import Case, case
from studies.stability.solver.starts import as_from_rest, cantilever


def _theta(*values: float) -> Case:
    return Case(cantilever(), np.array(values))


@case("theta")
def theta_in_float32() -> Case:
    return Case(cantilever(), jnp.asarray(moduli(), jnp.float32), claim=as_from_rest)


@case("theta")
def theta_with_NaN() -> Case:
    return _theta(5.0, np.nan)


@case("theta")
def theta_with_inf() -> Case:
    return _theta(np.inf, 5.0)


@case("theta")
def theta_zero() -> Case:
    return _theta(0.0, 0.0)


@case("theta")
def theta_zero_inside_jit() -> Case:
    return replace(_theta(0.0, 0.0), inside_jit=True)


@case("theta")
def theta_without_shear_stiffness_inside_jit() -> Case:
    return replace(_theta(0.0, 5.0), inside_jit=True)


@case("theta")
def theta_without_shear_stiffness() -> Case:
    return _theta(0.0, 5.0)


@case("theta")
def theta_without_volume_stiffness() -> Case:
    return _theta(5.0, 0.0)


def upwards(u: np.ndarray) -> str:
    return "" if u[:, 2].mean() <= 0.0 else "a hanging body that falls upwards"


@case("theta")
def theta_negative() -> Case:
    return replace(_theta(-5.0, -5.0), claim=upwards)


@case("theta")
def theta_slightly_negative_volume_stiffness() -> Case:
    return replace(_theta(5.0, -1.0), claim=upwards)


@case("theta")
def theta_1e300() -> Case:
    return _theta(1e300, 1e300)


@case("theta")
def theta_1e_300() -> Case:
    return _theta(1e-300, 1e-300)


@case("theta")
def theta_nu_half() -> Case:
    return Case(bar(engineering=True, loads=(DOWN,)), np.array([10.0, 0.5]))


@case("theta")
def theta_nu_minus_one() -> Case:
    return Case(bar(engineering=True, loads=(DOWN,)), np.array([10.0, -1.0]))


@case("theta")
def theta_nu_above_half() -> Case:
    scene = bar(engineering=True, loads=(DOWN,))
    return replace(Case(scene, np.array([10.0, 0.6])), claim=upwards)


@case("theta")
def theta_too_short() -> Case:
    return replace(_theta(5.0), claim=lambda _: "accepted one value for two parameters")


@case("theta")
def theta_too_long() -> Case:
    return replace(_theta(5.0, 5.0, 5.0), claim=lambda _: "accepted three values for two")
