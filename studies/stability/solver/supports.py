"""Supports too soft, or that ask for too much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from studies.stability.solver.bodies import DOWN, bar, moduli, moved
from studies.stability.solver.case import Case, case, near

import emulator as em


def _on_springs(stiffness: float, face: str = "top") -> Case:
    scene = bar(
        (10.0, 10.0, 10.0),
        (3, 3, 3),
        loads=(DOWN,),
        supports=(em.supports.ElasticSupport(face, stiffness),),
    )
    weight = 9.81e-3 * 1000.0  # mN

    def carried(u: np.ndarray) -> str:
        facets = scene.mesh.facet_set(face)
        sunk = -stiffness * float(u[facets, 2].mean()) * 100.0
        return near("force of the springs in mN", sunk, weight, 1e-4)

    return Case(scene, moduli(), claim=carried)


@case("supports")
def springs_1e_9() -> Case:
    return _on_springs(1e-9)


@case("supports")
def springs_1e_3() -> Case:
    return _on_springs(1e-3)


@case("supports")
def springs_1e_3_standing() -> Case:
    """Springs too soft for the body's weight: it topples and ends up hanging."""
    return _on_springs(1e-3, "bottom")


@case("supports")
def springs_1e12() -> Case:
    return _on_springs(1e12)


def _stretched(millimetres: float) -> Case:
    scene = bar((10.0, 10.0, 10.0), (4, 4, 4))
    return Case(moved(scene, {"left": (0, 0, 0), "right": (millimetres, 0, 0)}), moduli())


@case("supports")
def pulled_to_ten_times_its_length() -> Case:
    return _stretched(90.0)


@case("supports")
def pulled_to_a_thousand_times_its_length() -> Case:
    return _stretched(9990.0)


@case("supports")
def squeezed_to_half() -> Case:
    return _stretched(-5.0)


@case("supports")
def squeezed_to_a_hundredth() -> Case:
    return _stretched(-9.9)


@case("supports")
def squeezed_to_nothing() -> Case:
    return _stretched(-10.0)


@case("supports")
def pushed_through_itself() -> Case:
    return replace(_stretched(-25.0), claim=lambda _: "no such state exists")


@case("supports")
def traction_a_thousand_moduli() -> Case:
    return Case(bar(loads=(em.loads.Traction("right", (5000.0, 0.0, 0.0)),)), moduli())


@case("supports")
def traction_pushing_a_thousand_moduli() -> Case:
    return Case(bar(loads=(em.loads.Traction("right", (-5000.0, 0.0, 0.0)),)), moduli())
