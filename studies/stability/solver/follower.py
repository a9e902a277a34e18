"""Follower loads and limit points."""

from __future__ import annotations

import numpy as np
from studies.stability.solver.bodies import bar, moduli
from studies.stability.solver.case import Case, case, near

import emulator as em


def _follower_plate(pressure: float) -> Case:
    scene = bar(
        (40.0, 20.0, 2.0), (16, 8, 2), loads=(em.loads.FollowerPressure("bottom", pressure),)
    )
    return Case(scene, moduli(50.0, 50.0))


@case("follower pressure")
def follower_plate() -> Case:
    return _follower_plate(0.02)


@case("follower pressure")
def follower_plate_curls_up() -> Case:
    return _follower_plate(0.2)


@case("follower pressure")
def follower_plate_far_too_much() -> Case:
    return _follower_plate(20.0)


def _sphere(pressure: float) -> Case:
    """Incompressible Neo-Hookean, A = 10 and B = 15 mm, mu = 10 kPa: it bursts at 4.935 kPa."""
    mesh = em.generators.sphere_octant(10.0, 15.0, (4, 2), order=2)
    planes = tuple(em.Support(axis, components=axis) for axis in "xyz")
    loads = (em.loads.FollowerPressure("inner", pressure),)
    scene = bar(mesh=mesh, supports=planes, loads=loads, dilatation="mean")

    def stretch(u: np.ndarray) -> str:
        inner = scene.mesh.node_set("inner")
        radius = float(np.linalg.norm((scene.mesh.nodes + u)[inner], axis=1).mean())
        p = sphere_pressure(radius / 10.0)
        if pressure > 4.935 * 1.02:
            return f"equilibrium at inner radius {radius:.2f} mm, where only {p:.3f} kPa is carried"
        return near("pressure of that radius", p, pressure, 0.02)

    return Case(scene, moduli(10.0, 1e5), claim=stretch)


def sphere_pressure(inner: float) -> float:
    """Pressure in kPa at inner stretch ``inner``: mu [g(outer) - g(inner)], g = 2/l + 1/(2 l^4)."""
    outer = (1.0 + (inner**3 - 1.0) * (10.0 / 15.0) ** 3) ** (1.0 / 3.0)
    g = lambda stretch: 2.0 / stretch + 0.5 / stretch**4  # noqa: E731
    return 10.0 * (g(outer) - g(inner))


@case("follower pressure")
def sphere_4_kPa() -> Case:
    return _sphere(4.0)


@case("follower pressure")
def sphere_just_below_its_limit() -> Case:
    return _sphere(4.85)


@case("follower pressure")
def sphere_beyond_its_limit() -> Case:
    return _sphere(5.2)


@case("follower pressure")
def sphere_twice_its_limit() -> Case:
    return _sphere(10.0)


@case("follower pressure")
def sphere_sucked() -> Case:
    return _sphere(-10.0)
