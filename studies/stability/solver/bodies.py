"""Bodies that several families of cases share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from studies.stability.solver.case import SEED

import emulator as em

MODULI = (em.Parameter("mu", "kPa", 1.0, 10.0, "log"), em.Parameter("lam", "kPa", 1.0, 10.0, "log"))
ENGINEERING = (em.Parameter("E", "kPa", 1.0, 25.0, "log"), em.Parameter("nu", "", 0.1, 0.4, "log"))
CLAMPED = (em.Support("left"),)


def bar(
    lengths: tuple[float, float, float] = (40.0, 10.0, 10.0),
    cells: tuple[int, int, int] = (8, 2, 2),
    *,
    order: int = 1,
    engineering: bool = False,
    **rest: Any,
) -> em.Scene:
    """A Neo-Hookean bar along x, by default clamped at its left end."""
    mesh = rest.pop("mesh", None) or em.generators.box(lengths, cells)
    return em.Scene(
        name="bar",
        mesh=mesh if order == 1 else em.geometry.to_quadratic(mesh),
        law=em.find_law("neo_hookean_E_nu" if engineering else "neo_hookean"),
        parameters=ENGINEERING if engineering else MODULI,
        **{"supports": CLAMPED, **rest},
    )


def moduli(mu: float = 5.0, lam: float = 5.0) -> np.ndarray:
    """Theta of a bar."""
    return np.array([mu, lam])


DOWN = em.loads.Gravity(direction=(0.0, 0.0, -1.0))


def moved(scene: em.Scene, ends: dict[str, np.ndarray | tuple[float, float, float]]) -> em.Scene:
    """``scene`` with node sets moved by so many mm."""
    supports = tuple(em.Support(name, np.asarray(shift, float)) for name, shift in ends.items())
    return replace(scene, supports=supports)


def jittered(mesh: em.Mesh, amount: float) -> em.Mesh:
    """Inner nodes moved at random; moves are halved until all volumes are positive."""
    rng = np.random.default_rng(SEED)
    spacing = np.ptp(mesh.nodes, axis=0).min() / 4
    shift = amount * spacing * rng.uniform(-1.0, 1.0, mesh.nodes.shape)
    shift[np.unique(mesh.surface)] = 0.0
    whole = np.abs(em.geometry.signed_volumes(mesh.nodes, mesh.elements))
    for _ in range(60):
        volumes = em.geometry.signed_volumes(mesh.nodes + shift, mesh.elements)
        bad = np.unique(mesh.elements[volumes < 1e-4 * whole])
        if not bad.size:
            break
        shift[bad] *= 0.8
    return replace(mesh, nodes=mesh.nodes + shift)


_HUMAN_WALL = em.generators.EllipsoidalWall(23.0, 58.0, 34.0, 65.0, base=20.0)
_THIN_WALL = em.generators.EllipsoidalWall(33.0, 64.0, 34.0, 65.0, base=20.0)
_PRESSURE = em.Parameter("pressure", "kPa", 4 * em.loads.KPA_PER_MMHG, 10 * em.loads.KPA_PER_MMHG)


@cache
def ventricle(*, thin: bool = False, order: int = 1, dilatation: str = "pointwise") -> em.Scene:
    """A human-sized ventricle, Holzapfel-Ogden, pressure in mmHg to kPa as its only parameter."""
    wall, layers = (_THIN_WALL, 1) if thin else (_HUMAN_WALL, 2)
    rings, around = (5, 12) if order == 2 else (10, 24)
    mesh = em.generators.truncated_ellipsoid(wall, rings, around, layers, order)
    return em.Scene(
        name="ventricle",
        mesh=mesh,
        law=em.find_law("holzapfel_ogden"),
        parameters=(_PRESSURE,),
        loads=(em.loads.CavityPressure("endocardium"),),
        supports=(em.Support("base"),),
        constants={
            "a": 0.3,
            "b": 3.0,
            "a_f": 6.0,
            "b_f": 3.0,
            "kappa": 25.0 if dilatation == "pointwise" else 1e4,
        },
        fibres=em.scenes.Helix((90.0, -90.0)).directions(mesh)[0],
        dilatation=dilatation,
    )


def mmHg(value: float) -> np.ndarray:
    return np.array([value * em.loads.KPA_PER_MMHG])


def grows(scene: em.Scene, sign: float) -> Callable[[np.ndarray], str]:
    """The cavity gains volume under pressure and loses it under suction."""

    def claim(u: np.ndarray) -> str:
        facets = scene.mesh.facet_set("endocardium")[:, :3]

        def volume(x: np.ndarray) -> float:
            a, b, c = x[facets].swapaxes(0, 1)
            return -float(np.einsum("ki,ki->k", a, np.cross(b, c)).sum()) / 6.0

        change = volume(scene.mesh.nodes + u) - volume(scene.mesh.nodes)
        return "" if change * sign > 0.0 else f"cavity volume changes by {change:.3g} mm3"

    return claim


def guccione(mesh: em.Mesh, fibres: np.ndarray, **rest: Any) -> em.Scene:
    """Guccione's law with C as its only parameter."""
    return em.Scene(
        name="guccione",
        mesh=mesh,
        law=em.find_law("guccione"),
        parameters=(em.Parameter("C", "kPa", 1.0, 10.0, "log"),),
        fibres=fibres,
        **rest,
    )


def exponents(b_f: float, b_t: float, b_fs: float, kappa: float) -> dict[str, float]:
    return {"b_f": b_f, "b_t": b_t, "b_fs": b_fs, "kappa": kappa}


def along_x(mesh: em.Mesh) -> np.ndarray:
    return np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1))


def twist(points: np.ndarray, centre: np.ndarray, degrees: float) -> np.ndarray:
    """Displacement (k, 3) of ``points`` (k, 3) mm turned about an axis along x, by ``centre``."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    arm = points[:, 1:] - centre[1:]
    return np.column_stack([np.zeros(len(arm)), arm @ np.array([[c, s], [-s, c]]) - arm])
