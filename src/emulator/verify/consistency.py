"""Check what holds for every law: patch test, rigid motions, closed surfaces, derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem import Simulator
from emulator.fem.energy import strain_energy
from emulator.geometry.discretisation import discretise
from emulator.geometry.generators.box import box
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_quadratic
from emulator.mechanics.kinematics import Barriers, Strain
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads import FollowerPressure, Gravity
from emulator.verify.benchmark import Benchmark
from emulator.verify.homogeneous import SOLUTIONS

_FACES = ("left", "right", "front", "back", "bottom", "top")
FORMS: dict[str, tuple[int, Literal["pointwise", "mean"]]] = {
    "P1": (1, "pointwise"),
    "P2": (2, "pointwise"),
    "P2, mean dilatation": (2, "mean"),
}
"""Order of the elements and treatment of volume changes, by name."""


def block(form: str) -> Scene:
    """Return a clamped block of 2 x 3 x 4 mm, heavy enough to bend, in one of ``FORMS``."""
    order, dilatation = FORMS[form]
    mesh = box((2.0, 3.0, 4.0), (2, 2, 2))
    return Scene(
        name=f"block, {form}",
        mesh=mesh if order == 1 else to_quadratic(mesh),
        law=find_law("neo_hookean_split"),
        parameters=(Parameter("mu", "kPa", 5.0, 20.0), Parameter("kappa", "kPa", 20.0, 80.0)),
        loads=(Gravity(density=40.0, direction=(0.3, -0.2, -1.0)),),
        supports=(Support("left"),),
        dilatation=dilatation,
    )


def _zero(name: str, measured: float) -> Benchmark:
    """Return the row of a number that is zero but for round-off."""
    return Benchmark(name, measured, 0.0, 1e-12, "holds exactly; the tolerance is round-off")


def verify_patch() -> list[Benchmark]:
    """Check that an affine displacement of the surface makes the whole field affine."""
    H = 0.2 * np.random.default_rng(0).normal(size=(3, 3))
    rows = []
    for form in FORMS:
        scene = block(form)
        nodes, sets = scene.mesh.nodes, scene.mesh.node_sets
        faces = tuple(Support(face, nodes[sets[face]] @ H.T) for face in _FACES)
        scene = replace(scene, supports=faces, loads=())
        u = Simulator(scene)(scene.centre)
        error = float(jnp.max(jnp.abs(u - nodes @ H.T)) / np.abs(nodes @ H.T).max())
        rows.append(_zero(f"patch test, {form}: relative error", error))
    return rows


def verify_invariance() -> list[Benchmark]:
    """Check that rotations store no energy, laws ignore the frame, and closed surfaces balance."""
    return [*_rotated_blocks(), *_rotated_points(), *_closed_surfaces()]


def _rotation() -> np.ndarray:
    """Return a proper rotation far from the identity."""
    q, r = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def _rotated_blocks() -> list[Benchmark]:
    """Check that rigid rotations of a block cost no energy and no force."""
    rows = []
    for form in FORMS:
        scene = block(form)
        u = jnp.asarray(scene.mesh.nodes @ (_rotation() - np.eye(3)).T)
        energy, force = jax.jit(jax.value_and_grad(strain_energy(scene)))(u, scene.centre)
        # Energy and force are compared with mu V and mu V^(2/3), their sizes at strains of one.
        mu, volume = float(scene.centre[0]), float(scene.discretisation.weights.sum())
        name = f"rigid rotation, {form}"
        rows.append(_zero(f"{name}: energy / mu V", float(energy) / (mu * volume)))
        largest = float(jnp.max(jnp.abs(force))) / (mu * volume ** (2 / 3))
        rows.append(_zero(f"{name}: largest force / mu V^(2/3)", largest))
    return rows


def _rotated_points() -> list[Benchmark]:
    """Check the frame indifference of every law but small strain, which has none."""
    F = np.eye(3) + 0.2 * np.random.default_rng(3).normal(size=(3, 3))
    directions = jnp.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0]]) / 3.0  # fibre, sheet
    rows = []
    for name, (_, values) in SOLUTIONS.items():
        law = find_law(name)
        if not law.objective:
            continue

        def energy(G: np.ndarray, law=law, values=values) -> float:  # noqa: ANN001
            strain = Strain(jnp.asarray(G - np.eye(3)), None, directions)
            return float(law.energy(strain, *map(jnp.asarray, values.values())))

        change = energy(_rotation() @ F) / energy(F) - 1.0
        rows.append(_zero(f"frame indifference, {name}", change))
    return rows


def _closed_surfaces() -> list[Benchmark]:
    """Check that a pressure on the whole, badly deformed surface of a block has no net force."""
    rows = []
    for form in ("P1", "P2"):
        scene = block(form)
        mesh = scene.mesh
        enclosed = Mesh(mesh.nodes, mesh.elements, mesh.node_sets, {"all": mesh.surface})
        forces = FollowerPressure("all", 1.0).force(discretise(enclosed))
        u = 0.2 * np.random.default_rng(1).normal(size=mesh.nodes.shape)
        force = np.asarray(forces.total(jnp.asarray(u), {}))
        net = float(np.linalg.norm(force.sum(axis=0)) / np.abs(force).sum())
        rows.append(_zero(f"closed surface, {form}: net pressure force", net))
    return rows


def verify_derivatives() -> list[Benchmark]:
    """Check that remainders after the first derivative fall with the square of the step."""
    rows = []
    for form in FORMS:
        simulator = Simulator(block(form))
        rows += [*taylor_of_energy(form, simulator), _taylor_of_solution(form, simulator)]
    return rows


def taylor_of_energy(form: str, simulator: Simulator) -> list[Benchmark]:
    """Measure the orders of the remainders of energy and residual near an equilibrium."""
    system, theta = simulator.system, simulator.scene.centre
    rng = np.random.default_rng(2)
    u = simulator(theta) + system.extend(jnp.asarray(0.02 * rng.normal(size=len(system.free))))
    v = system.extend(jnp.asarray(rng.normal(size=len(system.free))))
    energy = jax.jit(lambda w: system.potential(w, theta)[0])
    residual = jax.jit(lambda w: system.residual(w, theta))
    work = jnp.vdot(residual(u), system.restrict(v))
    force = system.pattern.product(system.tangent(u, theta), system.restrict(v))
    return [
        _order(f"{form}: order of energy", lambda h: energy(u + h * v) - energy(u) - h * work),
        _order(
            f"{form}: order of residual", lambda h: residual(u + h * v) - residual(u) - h * force
        ),
    ]


def _taylor_of_solution(form: str, simulator: Simulator) -> Benchmark:
    """Measure the order of the remainder of the equilibrium in theta."""
    theta, direction = simulator.scene.centre, jnp.array([1.0, -2.0])
    solve = jax.jit(lambda t: simulator.solve(t).displacement)
    u, slope = jax.jvp(solve, (theta,), (direction,))
    return _order(
        f"{form}: order of du/dtheta", lambda h: solve(theta + h * direction) - u - h * slope, 2.0
    )


def _order(name: str, remainder: Callable[[float], jax.Array], first: float = 1e-2) -> Benchmark:
    """Measure the exponent of the step in a remainder: the slope of its logarithm.

    first : the largest of five steps, each half as long as the one before.
    """
    steps = first / 2.0 ** np.arange(5)
    sizes = [float(jnp.linalg.norm(jnp.atleast_1d(remainder(step)).ravel())) for step in steps]
    order = float(np.polyfit(np.log(steps), np.log(sizes), 1)[0])
    return Benchmark(f"Taylor, {name}", order, 2.0, 0.1, "theory")


def verify_barriers() -> list[Benchmark]:
    """Check the published barriers by the formulas and constants of the paper (Eq. 21-23)."""
    barriers = Barriers()
    # beta_1 = 1 / (0.05 - 0.001) and beta_2 = ln(0.05 - 0.001) - 0.05 beta_1.
    beta_1 = 1.0 / 0.049
    beta_2 = np.log(0.049) - 0.05 * beta_1
    cases = [
        *((barriers.limit_J, J, 0.001 + np.exp(beta_1 * J + beta_2)) for J in (0.05, 0.0, -0.5)),
        (barriers.limit_J, 0.8, 0.8),
        *((barriers.limit_I1, value, 10.0 + np.tanh(value - 10.0)) for value in (10.0, 10.7, 25.0)),
        (barriers.limit_I1, 4.0, 4.0),
        *((barriers.limit_I4f, value, 8.0 + np.tanh(value - 8.0)) for value in (8.0, 8.4, 30.0)),
    ]
    source = "Dalton et al. (2023), Eq. 21-23"
    rows = []
    for limit, value, expected in cases:
        name = f"barrier {limit.__name__.removeprefix('limit_')} at {value:g}"
        measured = float(limit(jnp.asarray(value)))
        rows.append(Benchmark(name, measured, float(expected), 1e-12, source))
    return rows
