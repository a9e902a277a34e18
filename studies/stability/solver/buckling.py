"""Buckling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from studies.stability.solver.bodies import DOWN, bar, moduli, moved
from studies.stability.solver.case import Case, case

import emulator as em


def _column(shortening: float, tilt: float = 0.0) -> Case:
    """Slenderness 20, both ends clamped: Euler's critical shortening is 4 pi^2 / 1200 = 3.3 %."""
    scene = bar((100.0, 5.0, 5.0), (30, 2, 2))
    if tilt:
        nodes = scene.mesh.nodes.copy()
        nodes[:, 2] += tilt * np.sin(np.pi * nodes[:, 0] / 100.0) ** 2
        scene = replace(scene, mesh=replace(scene.mesh, nodes=nodes))
    scene = moved(scene, {"left": (0, 0, 0), "right": (-100.0 * shortening, 0, 0)})
    return Case(scene, moduli())


@case("buckling")
def column_perfect_10_percent() -> Case:
    return _column(0.10)


@case("buckling")
def column_perfect_40_percent() -> Case:
    return _column(0.40)


@case("buckling")
def column_imperfect_10_percent() -> Case:
    case = _column(0.10, tilt=0.5)
    middle = np.abs(case.scene.mesh.nodes[:, 0] - 50.0) < 1e-9

    def bulges(u: np.ndarray) -> str:
        deflection = np.linalg.norm(u[middle, 1:].mean(axis=0))
        return "" if deflection > 10.0 else f"deflection {deflection:.2f} mm: not the bent branch"

    return replace(case, claim=bulges)


@case("buckling")
def column_imperfect_40_percent() -> Case:
    return _column(0.40, tilt=0.5)


def _loaded_column(factor: float, side: float) -> Case:
    """Dead load on the free end of a cantilever, in units of Euler's pi^2 E I / 4 L^2."""
    mu = lam = 5.0
    E = mu * (3 * lam + 2 * mu) / (lam + mu)
    critical = np.pi**2 * E * 5.0**2 / 12.0 / 4.0 / 100.0**2  # kPa
    load = em.loads.Traction("right", (-factor * critical, 0.0, side * critical))
    return Case(bar((100.0, 5.0, 5.0), (30, 2, 2), loads=(load,)), moduli(mu, lam))


@case("buckling")
def column_dead_load_twice_critical() -> Case:
    return _loaded_column(2.0, 0.0)


@case("buckling")
def column_dead_load_twice_critical_pushed() -> Case:
    return _loaded_column(2.0, 0.01)


@case("buckling")
def column_dead_load_twenty_times_critical() -> Case:
    return _loaded_column(20.0, 0.01)


@case("buckling")
def plate_one_element_thick_squeezed() -> Case:
    scene = bar((100.0, 50.0, 1.0), (24, 12, 1))
    return Case(moved(scene, {"left": (0, 0, 0), "right": (-5.0, 0, 0)}), moduli())


@case("buckling")
def plate_one_element_thick_hanging() -> Case:
    return Case(bar((100.0, 50.0, 1.0), (24, 12, 1), loads=(DOWN,)), moduli(1000.0, 1000.0))


@case("buckling")
def plate_one_element_thick_hanging_soft() -> Case:
    return Case(bar((100.0, 50.0, 1.0), (24, 12, 1), loads=(DOWN,)), moduli())


@case("buckling")
def arch_snaps_through() -> Case:
    """A shallow arch, ends held, pushed down past its limit point."""
    scene = bar((100.0, 10.0, 2.0), (30, 2, 1))
    nodes = scene.mesh.nodes.copy()
    nodes[:, 2] += 8.0 * np.sin(np.pi * nodes[:, 0] / 100.0)
    scene = replace(
        scene,
        mesh=replace(scene.mesh, nodes=nodes),
        supports=(em.Support("left"), em.Support("right")),
        loads=(em.loads.Traction("top", (0.0, 0.0, -0.02)),),
    )
    return Case(scene, moduli())
