"""Reference solutions a forward map is judged by: released ones, or our own FEM."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from emulator.errors import InputError
from emulator.fem import Simulator, run_campaign, sobol
from emulator.released.scenes import published_scene, published_tests
from emulator.scenes.scene import Scene
from emulator.surrogates.protocol import inside_box

SEED = 90_210  # test points of their own: training and reduced models draw with small seeds
# What the ventricle agrees to: its fibres were stored in float32 (calibrate verify published).
ENERGY_TOLERANCE = 1e-6


class Reference(NamedTuple):
    """Theta (c, p), displacement (c, n, 3) mm, where it is from, and how many solves failed."""

    thetas: jax.Array
    displacement: jax.Array
    source: str
    failed: int = 0


def fem_reference(simulator: Simulator, cases: int, *, progress: bool = False) -> Reference:
    """Our FEM at ``cases`` theta over the box; :class:`SolverError` when one fails."""
    runs = run_campaign(simulator, sobol(simulator.scene, cases, SEED), progress=progress)
    return Reference(runs.theta, runs.displacement, "our FEM")


# ---- released solutions -----------------------------------------------------------------------
def published_reference(scene: Scene, folder: str | Path, *, progress: bool = False) -> Reference:
    """The released test cases in ``folder``, for a scene that is the released model.

    Where the release holds no displacements they are ours at the released theta, and their energies
    must be the released ones.

    Raises
    ------
    InputError
        Another scene, or an energy more than ``ENERGY_TOLERANCE`` away.
    """
    folder = Path(folder).resolve()
    model = folder.name
    released = published_scene(model, folder.parent)
    if not _same(released, scene):
        raise InputError(
            f"published model '{model}' is not the scene '{scene.name}' of the emulator "
            "(mesh, supports, law, fibres, constants and loads must agree)"
        )
    thetas, tests = published_tests(model, folder.parent)
    order = np.array([released.parameter_names.index(name) for name in scene.parameter_names])
    if tests.displacement is not None:
        return Reference(
            thetas[:, order], jnp.asarray(tests.displacement), "released displacements"
        )
    runs = run_campaign(Simulator(released), thetas, progress=progress)
    _check_energies(model, np.asarray(runs.energy), tests.energy)
    return Reference(thetas[:, order], runs.displacement, "our FEM at the released theta")


def _check_energies(model: str, ours: np.ndarray, released: np.ndarray) -> None:
    error = np.abs(ours / released - 1.0)
    worst = int(np.argmax(error))
    if not error[worst] <= ENERGY_TOLERANCE:
        raise InputError(
            f"published model '{model}': our FEM's energy in case {worst} is {ours[worst]:.9g} "
            f"mN mm, the released one {released[worst]:.9g} (relative difference "
            f"{error[worst]:.2g}, at most {ENERGY_TOLERANCE:g})"
        )


def _same(a: Scene, b: Scene) -> bool:
    """Whether two scenes have the same solutions, nodes in the same order; ranges may differ."""
    return (
        a.mesh.nodes.shape == b.mesh.nodes.shape
        and np.allclose(a.mesh.nodes, b.mesh.nodes, atol=1e-6 * b.mesh.size)
        and np.array_equal(_as_set(a.mesh.elements), _as_set(b.mesh.elements))
        and np.array_equal(a.held, b.held)
        and np.allclose(a.held_displacement, b.held_displacement)
        and a.law.name == b.law.name
        and a.loads == b.loads
        and sorted(a.parameter_names) == sorted(b.parameter_names)
        and dict(a.constants) == dict(b.constants)
        and _same_fibres(a, b)
    )


def _same_fibres(a: Scene, b: Scene) -> bool:
    """Whether both have the same fibre in every element, or neither has any."""
    if a.fibres is None or b.fibres is None:
        return a.fibres is b.fibres
    first, second = (s.fibres[_by_corners(s.mesh.elements)] for s in (a, b))  # type: ignore[index]
    return np.allclose(first, second, atol=1e-6)


def _by_corners(elements: np.ndarray) -> np.ndarray:
    """The order (m,) that sorts elements by their sorted corners, however they are listed."""
    return np.lexsort(np.sort(elements, axis=1).T)


def _as_set(elements: np.ndarray) -> np.ndarray:
    return np.unique(np.sort(elements, axis=1), axis=0)


# ---- outside the box --------------------------------------------------------------------------
def sample_outside(scene: Scene, cases: int, fraction: float) -> jax.Array:
    """Theta (cases, p) outside the box, in the box widened by ``fraction`` of each side, both ways.

    Widened on each parameter's scale; values that law and loads do not take are left out.
    """
    if not 0.0 < fraction < np.inf:
        raise InputError(f"outside is {fraction}; give a fraction above 0, e.g. 0.25")
    count = 2 * cases
    for _ in range(12):
        widened = scene.to_unit(sobol(scene, count, SEED + 1)) * (1.0 + 2.0 * fraction) - fraction
        thetas = scene.from_unit(widened)
        admitted = ~np.asarray(inside_box(scene, thetas)) & _admissible(scene, np.asarray(thetas))
        if admitted.sum() >= cases:
            return thetas[np.flatnonzero(admitted)[:cases]]
        count *= 2
    raise InputError(f"outside {fraction:g}: next to nothing there is a value the scene takes")


def _admissible(scene: Scene, thetas: np.ndarray) -> np.ndarray:
    """Whether every entry of each theta (c, p) is one that law and loads take, (c,) bool."""
    takers = (scene.law, *scene.loads)
    quantities = {quantity.name: quantity for taker in takers for quantity in taker.quantities}
    return np.array(
        [
            all(
                quantities[name].value_fault(float(value)) is None
                for name, value in zip(scene.parameter_names, theta, strict=True)
            )
            for theta in thetas
        ]
    )


def outside_reference(
    simulator: Simulator,
    cases: int,
    fraction: float,
    inside: Reference,
    *,
    progress: bool = False,
) -> Reference:
    """Our FEM outside the box, each from the nearest solution there is, else from rest.

    What does not converge is left out and counted.
    """
    scene = simulator.scene
    thetas = sample_outside(scene, cases, fraction)
    positions = list(np.asarray(scene.to_unit(inside.thetas)))
    fields, solved = list(inside.displacement), []
    for k, theta in enumerate(tqdm(thetas, "FEM outside", disable=not progress, unit="run")):
        position = np.asarray(scene.to_unit(theta))
        nearest = int(np.argmin(np.sum((np.array(positions) - position) ** 2, axis=1)))
        solution = simulator.solve(theta, fields[nearest])
        if not solution.converged:
            solution = simulator.solve(theta)
        if solution.converged:
            solved.append(k)
            positions.append(position)
            fields.append(solution.displacement)
    displacement = jnp.stack(fields[len(inside.thetas) :]) if solved else jnp.zeros((0, 0, 3))
    return Reference(thetas[np.array(solved, int)], displacement, "our FEM", cases - len(solved))
