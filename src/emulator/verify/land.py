"""The cardiac mechanics benchmark of Land et al. (2015), three incompressible problems.

The benchmark's material is exactly incompressible. Here the bulk modulus is so large that a larger
one would not change the digits compared.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from scipy.optimize.elementwise import find_root

from emulator.fem import Simulator
from emulator.geometry.discretisation import discretise
from emulator.geometry.generators.box import box
from emulator.geometry.generators.ellipsoid import LAND, land_ventricle
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_quadratic
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads import ActiveTension, CavityPressure, FollowerPressure, Load
from emulator.verify.benchmark import Benchmark

_BEAM = "Land et al. (2015), problem 1: 4.17 in the reproduction by fenicsx-pulse"
_VENTRICLE = (
    "Land et al. (2015), problem 2; {value} by own axisymmetric Q2-Q1 elements, converged to 0.01"
)
_CONTRACTION = (
    "Land et al. (2015), problem 3; {value} by axisymmetric Q2-Q1 elements with torsion "
    "(tests/axisymmetric_support.py)"
)
_WALLS = ("endocardium", "epicardium")
KAPPA = 1e4  # kPa, 5000 times C of the beam, 1000 times C of the ventricle that is inflated


def beam(cells: tuple[int, int, int]) -> Scene:
    """Return half of the 10 x 1 x 1 mm beam, symmetric in y, with a pressure from below."""
    return _scene(
        "Land's beam",
        to_quadratic(box((10.0, 0.5, 1.0), cells)),
        (FollowerPressure("bottom", 0.004),),
        (Support("left"), Support("back", components="y")),
        {"b_f": 8.0, "b_t": 2.0, "b_fs": 4.0},
    )


def ventricle(rings: int, around: int, layers: int) -> Scene:
    """Return the truncated ellipsoid at a cavity pressure of 10 kPa, its base fixed."""
    return _scene(
        "Land's ventricle",
        land_ventricle(rings, around, layers, order=2),
        (CavityPressure("endocardium", 10.0),),
        (Support("base"),),
        {"b_f": 1.0, "b_t": 1.0, "b_fs": 1.0},
    )


def contraction(rings: int, around: int, layers: int) -> Scene:
    """Return the ellipsoid with fibres, at 15 kPa and an active tension of 60 kPa, base fixed."""
    mesh = land_ventricle(rings, around, layers, order=2)
    return _scene(
        "Land's contracting ventricle",
        mesh,
        (CavityPressure("endocardium", 15.0), ActiveTension(60.0)),
        (Support("base"),),
        {"b_f": 8.0, "b_t": 2.0, "b_fs": 4.0},
        fibres(mesh),
    )


def fibres(mesh: Mesh) -> np.ndarray:
    r"""Return the benchmark's fibres (m, q, 3) at the quadrature points.

    At the depth t, 0 inside and 1 outside, :math:`x = (r_s \sin u \cos v, r_s \sin u \sin v,
    r_l \cos u)` with the semi-axes :math:`r_s = 7 + 3t`, :math:`r_l = 17 + 3t` mm, and

    .. math:: f = \sin\alpha\, \frac{x_{,u}}{|x_{,u}|} + \cos\alpha\, \frac{x_{,v}}{|x_{,v}|},
        \qquad \alpha = 90^\circ - 180^\circ\, t .
    """
    grid = discretise(mesh)
    x, y, z = np.moveaxis(np.einsum("qa,mai->mqi", grid.values, mesh.nodes[mesh.elements]), -1, 0)
    t = find_root(_outside, (-0.1, 1.1), args=(np.hypot(x, y), z)).x
    short, long = _semi_axes(t)
    u, v = np.arctan2(np.hypot(x, y) / short, z / long), np.arctan2(y, x)
    along = (short * np.cos(u) * np.cos(v), short * np.cos(u) * np.sin(v), -long * np.sin(u))
    meridian = np.stack(along, axis=-1)
    meridian /= np.linalg.norm(meridian, axis=-1, keepdims=True)
    circle = np.stack([-np.sin(v), np.cos(v), np.zeros_like(v)], axis=-1)
    alpha = np.radians(90.0 - 180.0 * t)[..., None]
    return np.sin(alpha) * meridian + np.cos(alpha) * circle


def _semi_axes(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the short and long semi-axes in mm of the ellipsoid at the depth ``t``."""
    short = LAND.short_endocardium + t * (LAND.short_epicardium - LAND.short_endocardium)
    return short, LAND.long_endocardium + t * (LAND.long_epicardium - LAND.long_endocardium)


def _outside(t: np.ndarray, radius: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return by how much points at ``radius`` from the axis lie outside the ellipsoid at ``t``."""
    short, long = _semi_axes(t)
    return (radius / short) ** 2 + (z / long) ** 2 - 1.0


def _scene(
    name: str,
    mesh: Mesh,
    loads: tuple[Load, ...],
    supports: tuple[Support, ...],
    exponents: dict[str, float],
    fibres: np.ndarray | None = None,
) -> Scene:
    along_x = np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1))
    return Scene(
        name=name,
        mesh=mesh,
        law=find_law("guccione"),
        parameters=(Parameter("C", "kPa", 1.0, 20.0),),
        loads=loads,
        supports=supports,
        constants={**exponents, "kappa": KAPPA},
        fibres=along_x if fibres is None else fibres,
        dilatation="mean",
    )


def beam_tip(scene: Scene) -> float:
    """Return the deformed z in mm of the point (10, 0.5, 1)."""
    solution = Simulator(scene).solve(jnp.array([2.0])).require_converged(scene.name)
    tip = int(np.argmin(np.linalg.norm(scene.mesh.nodes - [10.0, 0.5, 1.0], axis=1)))
    return float(scene.mesh.nodes[tip, 2] + solution.displacement[tip, 2])


def apexes(scene: Scene, C: float) -> tuple[float, float]:
    """Return the deformed z in mm of the apex, inside and outside; ``C`` in kPa."""
    solution = Simulator(scene).solve(jnp.array([C])).require_converged(scene.name)
    z = scene.mesh.nodes[:, 2] + np.asarray(solution.displacement)[:, 2]
    inside, outside = (scene.mesh.node_set(f"apex_{wall}") for wall in _WALLS)
    return float(z[inside[0]]), float(z[outside[0]])


def verify_beam() -> list[Benchmark]:
    """Check problem 1, the beam.

    The cells and the tolerance are from docs/experiments.md, "Land's beam and the pressure through
    its height".
    """
    scene = beam((40, 2, 10))
    name = f"Land 1, {len(scene.mesh.nodes)} nodes: deformed z of (10, 0.5, 1) in mm"
    return [Benchmark(name, beam_tip(scene), 4.17, 0.02, _BEAM)]


def verify_ventricle() -> list[Benchmark]:
    """Check problem 2, both apexes of the inflated ventricle."""
    inside, outside = (-26.61, 0.005 * 26.61, "-26.611"), (-28.28, 0.005 * 28.28, "-28.278")
    return _apex_rows("Land 2", ventricle(10, 20, 3), 10.0, _VENTRICLE, inside, outside)


def verify_contraction() -> list[Benchmark]:
    """Check problem 3, both apexes of the contracting ventricle.

    Fibres have no direction on the axis, where the inner apex converges slowly: tolerances are
    from docs/experiments.md, "Land's contracting ventricle".
    """
    inside, outside = (-12.33, 0.25, "-12.33"), (-15.47, 0.08, "-15.47")
    return _apex_rows("Land 3", contraction(11, 24, 4), 2.0, _CONTRACTION, inside, outside)


def _apex_rows(
    problem: str, scene: Scene, C: float, source: str, *references: tuple[float, float, str]
) -> list[Benchmark]:
    """Compare the apexes with their z in mm, its tolerance, and the value by other elements."""
    rows, walls = [], zip(_WALLS, apexes(scene, C), references, strict=True)
    for wall, z, (value, tolerance, digits) in walls:
        name = f"{problem}, {len(scene.mesh.nodes)} nodes: apex, {wall} in mm"
        rows.append(Benchmark(name, z, value, tolerance, source.format(value=digits)))
    return rows
