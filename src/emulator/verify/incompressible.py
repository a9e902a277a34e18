r"""Nearly incompressible bodies: Cook's membrane in bending and shear, and a thick sphere.

The Neo-Hookean sphere is under inner pressure. With the hoop stretch :math:`\lambda = r/R`,
incompressibility gives :math:`\lambda_b^3 - 1 = (\lambda_a^3 - 1)(A/B)^3`, and radial equilibrium,
:math:`d\sigma_r/dr = 2\mu(\lambda^2 - \lambda^{-4})/r`,

.. math:: p = \mu\,[f(\lambda_b) - f(\lambda_a)], \qquad
          f(\lambda) = \frac{2}{\lambda} + \frac{1}{2\lambda^4} .

The pressure has a maximum; the loads checked are below it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem import Simulator
from emulator.geometry.generators.box import box, cooks_membrane
from emulator.geometry.generators.sphere import sphere_octant
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import find_law
from emulator.mechanics.laws.neo_hookean import bulk_modulus
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads import CavityPressure, PublishedPressure, Traction
from emulator.verify.benchmark import Benchmark, order_of

COOK_MU, TRACTION = 422.5, 62.5  # kPa
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
_COOK_ORDER = "2.2 measured here; the corner where the clamp ends is a singularity"


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
    theta = jnp.array([COOK_MU, bulk_modulus(COOK_MU, nu)])
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
        order = order_of(*(deflection(simulator, nu) for simulator in mean.values()))
        name = f"Cook, nu {nu:g}, mean dilatation: order of convergence"
        rows.append((name, order, 2.2, 0.5, _COOK_ORDER))
    name = "Cook, nu 0.4999, P1 with parallel diagonals: share of the deflection"
    rows.append((name, locked / stiff, 0.36, 0.1, _LOCKED))
    return [Benchmark(*row) for row in rows]


INNER, OUTER, MU = 10.0, 15.0, 10.0
NU = 0.4999
STRETCH = 1.2  # at which the order of convergence is measured
_SOURCE = "closed form of the incompressible sphere"
_ORDER = "3.7 measured here; a pressure an element promises 2, quadratic displacements at most 4"
_WORK = "p dV of the same polyhedron, lambda^2 times that at rest"


def pressure_at(stretch: float) -> float:
    """Return the pressure in kPa that stretches the inner surface by ``stretch``."""

    def f(value: float) -> float:
        return 2.0 / value + 0.5 / value**4

    outside = (1.0 + (stretch**3 - 1.0) * (INNER / OUTER) ** 3) ** (1.0 / 3.0)
    return MU * (f(outside) - f(stretch))


def sphere_scene(cells: tuple[int, int], order: int = 2) -> Scene:
    """Return one eighth of the sphere, fixed normal to its planes of symmetry."""
    return Scene(
        name="thick sphere",
        mesh=sphere_octant(INNER, OUTER, cells, grading=1.5, order=order),
        law=find_law("neo_hookean_split"),
        parameters=(
            Parameter("mu", "kPa", 1.0, 100.0),
            Parameter("kappa", "kPa", 1e2, 1e9),
            Parameter("pressure", "kPa", 0.0, 10.0),
        ),
        loads=(CavityPressure("inner"),),
        supports=tuple(Support(plane, components=plane) for plane in "xyz"),
        dilatation="mean" if order == 2 else "pointwise",
    )


def inner_stretch(sphere: Simulator, stretch: float, nu: float = NU) -> float:
    """Return the mean hoop stretch of the inner surface at the pressure of ``stretch``."""
    theta = jnp.array([MU, bulk_modulus(MU, nu), pressure_at(stretch)])
    solution = sphere.solve(theta).require_converged("thick sphere")
    mesh = sphere.scene.mesh
    inner = mesh.node_set("inner")
    position = mesh.nodes[inner] + np.asarray(solution.displacement)[inner]
    return float(np.linalg.norm(position, axis=1).mean()) / INNER


def verify_sphere() -> list[Benchmark]:
    """Check the stretch at three pressures, its order of convergence, and the pressure's work."""
    rows, sphere = [], Simulator(sphere_scene((6, 4)))
    nodes = f"{len(sphere.scene.mesh.nodes)} nodes"
    for stretch in (1.1, 1.2, 1.3):
        measured = inner_stretch(sphere, stretch)
        name = f"thick sphere, {pressure_at(stretch):.4f} kPa, {nodes}: inner stretch"
        rows.append(Benchmark(name, measured, stretch, 0.005 * stretch, _SOURCE))
    nested = [Simulator(sphere_scene((n, n))) for n in (2, 4, 8)]
    for nu in (0.499, NU):
        order = order_of(*(inner_stretch(simulator, STRETCH, nu) for simulator in nested))
        name = f"thick sphere, nu {nu:g}: order of convergence"
        rows.append(Benchmark(name, order, 3.7, 0.5, _ORDER))
    return rows + verify_pressure_work()


def verify_pressure_work() -> list[Benchmark]:
    """Check the work of a pressure in a uniform swelling, exact and as released, over ``p dV``."""
    rows = []
    for stretch in (1.1, 1.5, 2.0):
        exact = _work_ratio(CavityPressure("inner"), stretch)
        published = _work_ratio(PublishedPressure("inner"), stretch)
        name = f"pressure work, swollen by {stretch:g}"
        rows.append(Benchmark(f"{name}: exact / p dV", exact, 1.0, 1e-10, _WORK))
        excess = 3.0 - 2.0 / stretch
        source = "3 - 2/lambda: the released work is differentiated through cof(F) too"
        rows.append(Benchmark(f"{name}: published / p dV", published, excess, 1e-10, source))
    return rows


def _work_ratio(load: CavityPressure | PublishedPressure, stretch: float) -> float:
    """Return the derivative of the load's work in a uniform ``stretch``, over ``p dV``."""
    scene = replace(sphere_scene((4, 2), order=1), loads=(load,))
    (term,) = load.terms(scene.discretisation)
    X = jnp.asarray(scene.mesh.nodes)
    derivative = jax.grad(lambda value: term.total((value - 1.0) * X, {"pressure": jnp.ones(())}))
    facets = scene.mesh.nodes[scene.mesh.facet_set("inner")]
    cone = -np.einsum("ki,ki->", facets[:, 0], np.cross(facets[:, 1], facets[:, 2])) / 6.0
    return float(-derivative(stretch) / (3.0 * stretch**2 * cone))
