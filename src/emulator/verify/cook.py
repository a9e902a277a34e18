"""Cook's membrane in plane strain: bending and shear, compressible and nearly incompressible."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import jax.numpy as jnp
import numpy as np

from emulator.fem import Simulator
from emulator.geometry.generators.box import box, cooks_membrane
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import find_law
from emulator.mechanics.laws.neo_hookean import bulk_modulus
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads import Traction
from emulator.verify.benchmark import Benchmark, order_of

MU, TRACTION = 422.5, 62.5  # kPa
POINT = (48.0, 52.0)  # mm, middle of the loaded edge
_COMPRESSIBLE = (
    "14.74 by deal.II Q2 and 14.7273, still rising, by Abaqus CPE4H with 36 864 cells "
    "(solids4foam's cooksMembrane verification)"
)
_INCOMPRESSIBLE = (
    "own mixed Q2-Q1 quadrilaterals, 11.962 to 11.994 on meshes of 8 to 64 cells an edge; "
    "no published value for this material was found"
)
_FREE = "does not lock: ten times the bulk modulus changes nothing"
_LOCKED = "for warning, measured here: linear tetrahedra lock"
_ORDER = "2.2 measured here; the corner where the clamp ends is a singularity"


def membrane(cells: int, form: Literal["P1", "P2", "mean"]) -> Scene:
    """Return one layer of cells, fixed at its left edge and everywhere in z."""
    thickness = 48.0 / cells  # the width of a cell, for well-shaped tetrahedra
    if form == "P1":
        mesh = _parallel_diagonals(cells, thickness)
    else:
        mesh = cooks_membrane((cells, cells), thickness, order=2)
    return Scene(
        name=f"Cook's membrane, {form}",
        mesh=mesh,
        law=find_law("neo_hookean_split"),
        parameters=(Parameter("mu", "kPa", 100.0, 1000.0), Parameter("kappa", "kPa", 1e2, 1e9)),
        loads=(Traction("right", (0.0, TRACTION, 0.0)),),
        supports=(Support("left"), Support("all", components="z")),
        dilatation="mean" if form == "mean" else "pointwise",
    )


def _parallel_diagonals(cells: int, thickness: float) -> Mesh:
    """Return a linear mesh whose cells are all cut the same way, so that it locks.

    Cells cut by both diagonals hardly do (docs/experiments.md, "Linear tetrahedra do not always
    lock").
    """
    square = box((1.0, 1.0, thickness), (cells, cells, 1))
    x, y, z = square.nodes.T
    nodes = np.column_stack([48.0 * x, 44.0 * x + y * (44.0 - 28.0 * x), z])
    every = {**square.node_sets, "all": np.arange(len(nodes))}
    return replace(square, nodes=nodes, node_sets=every)


def deflection(membrane: Simulator, nu: float) -> float:
    """Return the vertical displacement of ``POINT`` in mm."""
    theta = jnp.array([MU, bulk_modulus(MU, nu)])
    solution = membrane.solve(theta).require_converged(membrane.scene.name)
    distance = np.linalg.norm(membrane.scene.mesh.nodes[:, :2] - POINT, axis=1)
    return float(solution.displacement[np.argmin(distance), 1])


def verify_cook() -> list[Benchmark]:
    """Check deflections and orders of the elements that do not lock, and of P1, which does."""
    mean = {cells: Simulator(membrane(cells, "mean")) for cells in (4, 8, 16)}
    finest = f"mean dilatation, {len(mean[16].scene.mesh.nodes)} nodes"
    quadratic, mixed = deflection(Simulator(membrane(8, "P2")), 0.3), deflection(mean[8], 0.3)
    stiff, stiffer = (deflection(mean[16], nu) for nu in (0.4999, 0.49999))
    locked = deflection(Simulator(membrane(16, "P1")), 0.4999)
    rows = [
        ("Cook, nu 0.3, P2: deflection in mm", quadratic, 14.73, 0.05, _COMPRESSIBLE),
        ("Cook, nu 0.3, mean dilatation: deflection in mm", mixed, 14.73, 0.05, _COMPRESSIBLE),
        (f"Cook, nu 0.4999, {finest}: in mm", stiff, 12.0, 0.12, _INCOMPRESSIBLE),
        ("Cook, mean dilatation: nu 0.49999 over nu 0.4999", stiffer / stiff, 1.0, 1e-3, _FREE),
    ]
    for nu in (0.499, 0.4999):
        order = order_of(*(deflection(each, nu) for each in mean.values()))
        name = f"Cook, nu {nu:g}, mean dilatation: order of convergence"
        rows.append((name, order, 2.2, 0.5, _ORDER))
    name = "Cook, nu 0.4999, P1 with parallel diagonals: share of the deflection"
    rows.append((name, locked / stiff, 0.36, 0.1, _LOCKED))
    return [Benchmark(*row) for row in rows]
