"""Ventricles at many times their pressure, and Land's two problems."""

from __future__ import annotations

from functools import cache

import numpy as np
from studies.stability.solver.bodies import (
    CLAMPED,
    along_x,
    exponents,
    grows,
    guccione,
    mmHg,
    ventricle,
)
from studies.stability.solver.case import SINGLE_STEP, Case, case, near, simulator_of

import emulator as em


@case("ventricles")
def ventricle_8_mmHg() -> Case:
    return Case(ventricle(), mmHg(8.0), claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_30_mmHg() -> Case:
    return Case(ventricle(), mmHg(30.0), claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_100_mmHg() -> Case:
    return Case(ventricle(), mmHg(100.0), claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_1000_mmHg() -> Case:
    return Case(ventricle(), mmHg(1000.0), claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_30_mmHg_single_step() -> Case:
    return Case(ventricle(), mmHg(30.0), options=SINGLE_STEP, claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_suction_5_mmHg() -> Case:
    return Case(ventricle(), mmHg(-5.0), claim=grows(ventricle(), -1.0))


@case("ventricles")
def ventricle_suction_30_mmHg() -> Case:
    return Case(ventricle(), mmHg(-30.0), claim=grows(ventricle(), -1.0))


@case("ventricles")
def ventricle_started_from_suction() -> Case:
    start = simulator_of(ventricle(), em.fem.NewtonOptions()).solve(mmHg(-3.0)).displacement
    return Case(ventricle(), mmHg(10.0), start, claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_suction_started_from_30_mmHg() -> Case:
    start = simulator_of(ventricle(), em.fem.NewtonOptions()).solve(mmHg(30.0)).displacement
    return Case(ventricle(), mmHg(-3.0), start, claim=grows(ventricle(), -1.0))


@case("ventricles")
def ventricle_one_element_thick() -> Case:
    scene = ventricle(thin=True)
    return Case(scene, mmHg(8.0), claim=grows(scene, 1.0))


@case("ventricles")
def ventricle_one_element_thick_30_mmHg() -> Case:
    scene = ventricle(thin=True)
    return Case(scene, mmHg(30.0), claim=grows(scene, 1.0))


@case("ventricles")
def ventricle_one_element_thick_suction() -> Case:
    """Past buckling: a thin shell under outside pressure."""
    scene = ventricle(thin=True)
    return Case(scene, mmHg(-1.0), claim=grows(scene, -1.0))


@case("ventricles")
def ventricle_incompressible_mean() -> Case:
    scene = ventricle(order=2, dilatation="mean")
    return Case(scene, mmHg(10.0), claim=grows(scene, 1.0))


@case("ventricles")
def ventricle_incompressible_mean_30_mmHg() -> Case:
    scene = ventricle(order=2, dilatation="mean")
    return Case(scene, mmHg(30.0), claim=grows(scene, 1.0))


@case("ventricles")
def land_beam() -> Case:
    """Problem 1 of Land et al. (2015); 5 % too soft on a mesh this coarse."""
    mesh = em.geometry.to_quadratic(em.generators.box((10.0, 1.0, 1.0), (20, 2, 2)))
    scene = guccione(
        mesh,
        along_x(mesh),
        loads=(em.loads.FollowerPressure("bottom", 0.004),),
        supports=CLAMPED,
        constants=exponents(8.0, 2.0, 4.0, 1e4),
        dilatation="mean",
    )
    tip = int(np.argmin(np.linalg.norm(mesh.nodes - [10.0, 0.5, 1.0], axis=1)))
    return Case(
        scene,
        np.array([2.0]),
        claim=lambda u: near("height of the tip", 1.0 + u[tip, 2], 4.17, 0.07),
    )


@cache
def land_ellipsoid_scene(pressure: float) -> em.Scene:
    mesh = em.generators.land_ventricle(rings=5, around=12, layers=1, order=2)
    return guccione(
        mesh,
        along_x(mesh),
        loads=(em.loads.CavityPressure("endocardium", pressure),),
        supports=(em.Support("base"),),
        constants=exponents(1.0, 1.0, 1.0, 1e5),
        dilatation="mean",
    )


@case("ventricles")
def land_ellipsoid() -> Case:
    """Problem 2 of Land et al. (2015), coarse."""
    scene = land_ellipsoid_scene(10.0)
    apex = int(scene.mesh.node_set("apex_endocardium")[0])
    height = scene.mesh.nodes[apex, 2]
    return Case(
        scene,
        np.array([10.0]),
        claim=lambda u: near("height of the apex", height + u[apex, 2], -26.53, 0.03),
    )


@case("ventricles")
def land_ellipsoid_three_times() -> Case:
    return Case(land_ellipsoid_scene(30.0), np.array([10.0]))
