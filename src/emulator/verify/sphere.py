r"""A thick incompressible Neo-Hookean sphere under inner pressure, and the work of that pressure.

With the hoop stretch :math:`\lambda = r/R`, incompressibility gives
:math:`\lambda_b^3 - 1 = (\lambda_a^3 - 1)(A/B)^3`, and radial equilibrium,
:math:`d\sigma_r/dr = 2\mu(\lambda^2 - \lambda^{-4})/r`,

.. math:: p = \mu\,[f(\lambda_b) - f(\lambda_a)], \qquad
          f(\lambda) = \frac{2}{\lambda} + \frac{1}{2\lambda^4} .

The pressure has a maximum; the loads checked are below it.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem import Simulator
from emulator.geometry.generators.sphere import sphere_octant
from emulator.mechanics.laws import find_law
from emulator.mechanics.laws.neo_hookean import bulk_modulus
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads import CavityPressure, PublishedPressure
from emulator.verify.benchmark import Benchmark, order_of

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
        order = order_of(*(inner_stretch(each, STRETCH, nu) for each in nested))
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
    term = load.term(scene.discretisation)
    X = jnp.asarray(scene.mesh.nodes)
    derivative = jax.grad(lambda value: term.total((value - 1.0) * X, {"pressure": jnp.ones(())}))
    facets = scene.mesh.nodes[scene.mesh.facet_set("inner")]
    cone = -np.einsum("ki,ki->", facets[:, 0], np.cross(facets[:, 1], facets[:, 2])) / 6.0
    return float(-derivative(stretch) / (3.0 * stretch**2 * cone))
