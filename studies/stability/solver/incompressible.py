"""Nearly incompressible material."""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np
from studies.stability.solver.bodies import DOWN, bar
from studies.stability.solver.case import CASES, Case, case

import emulator as em


def _incompressible(nu: float, order: int, dilatation: str) -> Case:
    scene = bar(order=order, engineering=True, loads=(DOWN,), dilatation=dilatation)

    def volume_kept(u: np.ndarray) -> str:
        change = solid_volume(scene, u) / solid_volume(scene, 0 * u) - 1
        return "" if abs(change) < 1e-3 else f"volume changes by {change:.1e}"

    return Case(scene, np.array([15.0, nu]), claim=volume_kept)


def solid_volume(scene: em.Scene, u: np.ndarray) -> float:
    """Volume inside the faces of the corners, mm3; of quadratic elements, nearly."""
    return float(em.geometry.signed_volumes(scene.mesh.nodes + u, scene.mesh.elements).sum())


for _nu, (_kind, _order, _dilatation) in itertools.product(
    (0.4999, 0.49999),
    (("linear", 1, "pointwise"), ("quadratic", 2, "pointwise"), ("mean", 2, "mean")),
):
    CASES[f"nu_{_nu}_{_kind}".replace(".", "_")] = (
        "nearly incompressible",
        partial(_incompressible, _nu, _order, _dilatation),
    )


def _cook(nu: float, factor: float) -> Case:
    E = 422.5 * 2 * (1 + nu)
    mesh = em.generators.cooks_membrane((6, 6), thickness=4.0, order=2)
    supports = (em.Support("left"), em.Support("all", components="z"))
    loads = (em.loads.Traction("right", (0.0, 62.5 * factor, 0.0)),)
    scene = bar(
        mesh=mesh, engineering=True, supports=supports, loads=loads, dilatation="mean", order=1
    )
    return Case(scene, np.array([E, nu]))


@case("nearly incompressible")
def cook_mean_nu_0_49999() -> Case:
    return _cook(0.49999, 1.0)


@case("nearly incompressible")
def cook_mean_nu_0_49999_ten_times() -> Case:
    return _cook(0.49999, 10.0)
