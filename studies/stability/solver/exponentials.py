"""Exponential laws near overflow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from studies.stability.solver.bodies import CLAMPED, DOWN, along_x, exponents
from studies.stability.solver.case import Case, case

import emulator as em


def pulled_fibres(law: str, stretch: float, constants: dict[str, float]) -> em.Scene:
    mesh = em.generators.box((10.0, 5.0, 5.0), (4, 2, 2))
    parameters = (em.Parameter(*(("C", "kPa", 0.1, 10.0) if law == "guccione" else _A_BOX)),)
    ends = (em.Support("left"), em.Support("right", np.array([10.0 * (stretch - 1.0), 0.0, 0.0])))
    return em.Scene(
        "fibres", mesh, em.find_law(law), parameters, (), ends, constants, along_x(mesh)
    )


_A_BOX = ("a", "kPa", 0.1, 10.0)


@case("exponentials")
def holzapfel_ogden_b_200() -> Case:
    constants = {"b": 200.0, "a_f": 1.0, "b_f": 200.0, "kappa": 100.0}
    return Case(pulled_fibres("holzapfel_ogden", 1.3, constants), np.array([1.0]))


@case("exponentials")
def holzapfel_ogden_b_1000_stretch_2() -> Case:
    constants = {"b": 1000.0, "a_f": 1.0, "b_f": 1000.0, "kappa": 100.0}
    return Case(pulled_fibres("holzapfel_ogden", 2.0, constants), np.array([1.0]))


@case("exponentials")
def guccione_b_f_100() -> Case:
    scene = pulled_fibres("guccione", 1.5, exponents(100.0, 50.0, 50.0, 100.0))
    return Case(scene, np.array([1.0]))


@case("exponentials")
def guccione_b_f_100_stretch_3() -> Case:
    """Q reaches 1600: exp overflows at 710."""
    scene = pulled_fibres("guccione", 3.0, exponents(100.0, 50.0, 50.0, 100.0))
    return Case(scene, np.array([1.0]))


@case("exponentials")
def guccione_started_where_exp_overflows() -> Case:
    scene = replace(
        pulled_fibres("guccione", 1.0, exponents(100.0, 50.0, 50.0, 100.0)),
        supports=CLAMPED,
        loads=(DOWN,),
    )
    start = np.where(scene.held, 0.0, scene.mesh.nodes * [3.0, 0.0, 0.0])
    return Case(scene, np.array([1.0]), start)


@case("exponentials")
def guccione_load_at_the_end_of_the_exponent() -> Case:
    """A traction so large that only Q near 700 balances it; no tissue carries it."""
    scene = replace(
        pulled_fibres("guccione", 1.0, exponents(20.0, 10.0, 10.0, 100.0)),
        supports=CLAMPED,
        loads=(em.loads.Traction("right", (1e12, 0.0, 0.0)),),
    )
    return Case(scene, np.array([1.0]))
