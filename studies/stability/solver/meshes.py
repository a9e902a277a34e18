"""Slivers and worse meshes."""

from __future__ import annotations

from studies.stability.solver.bodies import DOWN, bar, jittered, moduli, moved
from studies.stability.solver.case import Case, case

import emulator as em


@case("meshes")
def slivers() -> Case:
    mesh = jittered(em.generators.box((40.0, 10.0, 10.0), (12, 4, 4)), 1.5)
    return Case(bar(mesh=mesh, loads=(DOWN,)), moduli())


@case("meshes")
def slivers_pulled() -> Case:
    mesh = jittered(em.generators.box((40.0, 10.0, 10.0), (12, 4, 4)), 1.5)
    return Case(moved(bar(mesh=mesh), {"left": (0, 0, 0), "right": (40.0, 0, 0)}), moduli())


@case("meshes")
def slivers_quadratic() -> Case:
    mesh = em.geometry.to_quadratic(jittered(em.generators.box((40.0, 10.0, 10.0), (8, 3, 3)), 1.5))
    return Case(bar(mesh=mesh, loads=(DOWN,)), moduli())


@case("meshes")
def elements_100_to_1() -> Case:
    return Case(bar((400.0, 4.0, 4.0), (4, 4, 4), loads=(DOWN,)), moduli(5e3, 5e3))


@case("meshes")
def elements_10000_to_1() -> Case:
    return Case(bar((4e4, 4.0, 4.0), (4, 4, 4), loads=(em.loads.Gravity(1e-9),)), moduli(5e3, 5e3))


@case("meshes")
def one_cell() -> Case:
    return Case(bar((1.0, 1.0, 1.0), (1, 1, 1), loads=(em.loads.Gravity(100.0),)), moduli())


@case("meshes")
def micrometre_and_kilometre() -> Case:
    """A body of 1e6 mm, with tolerances meant for millimetres."""
    return Case(bar((4e6, 1e6, 1e6), (8, 2, 2), loads=(em.loads.Gravity(1e-6),)), moduli())
