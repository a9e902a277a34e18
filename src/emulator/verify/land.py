"""Two problems of the cardiac mechanics benchmark of Land et al. (2015), both incompressible.

The benchmark's material is exactly incompressible. Here the bulk modulus is so large that a larger
one would not change the digits compared.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from emulator.fem import Simulator
from emulator.geometry.bodies.box import box
from emulator.geometry.bodies.ellipsoid import land_ventricle
from emulator.geometry.mesh import Mesh
from emulator.geometry.quadratic import to_quadratic
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads import CavityPressure, FollowerPressure
from emulator.verify.benchmark import Benchmark

_BEAM = "Land et al. (2015), problem 1: 4.17 in the reproduction by fenicsx-pulse"
_VENTRICLE = (
    "Land et al. (2015), problem 2; {value} by own axisymmetric Q2-Q1 elements, converged to 0.01"
)
KAPPA = 1e4  # kPa, 5000 times C of the beam and 1000 times C of the ventricle


def beam(cells: tuple[int, int, int]) -> Scene:
    """Half of the 10 x 1 x 1 mm beam (it is symmetric in y), pressed from below."""
    return _scene(
        "Land's beam",
        to_quadratic(box((10.0, 0.5, 1.0), cells)),
        FollowerPressure("bottom", 0.004),
        (Support("left"), Support("back", components="y")),
        {"b_f": 8.0, "b_t": 2.0, "b_fs": 4.0},
    )


def ventricle(rings: int, around: int, layers: int) -> Scene:
    """The truncated ellipsoid at 10 kPa, its base held."""
    return _scene(
        "Land's ventricle",
        land_ventricle(rings, around, layers, order=2),
        CavityPressure("endocardium", 10.0),
        (Support("base"),),
        {"b_f": 1.0, "b_t": 1.0, "b_fs": 1.0},
    )


def _scene(
    name: str,
    mesh: Mesh,
    load: FollowerPressure | CavityPressure,
    supports: tuple[Support, ...],
    exponents: dict[str, float],
) -> Scene:
    return Scene(
        name=name,
        mesh=mesh,
        law=find_law("guccione"),
        parameters=(Parameter("C", "kPa", 1.0, 20.0),),
        loads=(load,),
        supports=supports,
        constants={**exponents, "kappa": KAPPA},
        fibres=np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1)),
        dilatation="mean",
    )


def beam_tip(scene: Scene) -> float:
    """Deformed z in mm of the point (10, 0.5, 1)."""
    solution = Simulator(scene).solve(jnp.array([2.0])).require_converged(scene.name)
    tip = int(np.argmin(np.linalg.norm(scene.mesh.nodes - [10.0, 0.5, 1.0], axis=1)))
    return float(scene.mesh.nodes[tip, 2] + solution.displacement[tip, 2])


def apexes(scene: Scene) -> tuple[float, float]:
    """Deformed z in mm of the apex, inside and outside."""
    solution = Simulator(scene).solve(jnp.array([10.0])).require_converged(scene.name)
    z = scene.mesh.nodes[:, 2] + np.asarray(solution.displacement)[:, 2]
    inside, outside = (scene.mesh.node_set(f"apex_{s}") for s in ("endocardium", "epicardium"))
    return float(z[inside[0]]), float(z[outside[0]])


def verify_beam() -> list[Benchmark]:
    """Problem 1.

    The cells and the tolerance are from docs/experiments.md, "Land's beam and the pressure through
    its height".
    """
    scene = beam((40, 2, 10))
    name = f"Land 1, {len(scene.mesh.nodes)} nodes: deformed z of (10, 0.5, 1) in mm"
    return [Benchmark(name, beam_tip(scene), 4.17, 0.02, _BEAM)]


def verify_ventricle() -> list[Benchmark]:
    """Problem 2: both apexes."""
    scene = ventricle(10, 20, 3)
    nodes, (inside, outside) = len(scene.mesh.nodes), apexes(scene)
    return [
        Benchmark(f"Land 2, {nodes} nodes: {where} in mm", z, value, 0.005 * abs(value), source)
        for where, z, value, source in (
            ("apex, endocardium", inside, -26.61, _VENTRICLE.format(value="-26.611")),
            ("apex, epicardium", outside, -28.28, _VENTRICLE.format(value="-28.278")),
        )
    ]
