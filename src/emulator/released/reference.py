"""The released test cases as reference solutions."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.campaign import run_campaign
from emulator.fem.campaign.designs import Reference
from emulator.fem.simulator import Simulator
from emulator.released.scenes import published_scene, published_tests
from emulator.scenes.scene import Scene

# Largest relative difference of energies; the ventricle's fibres are stored in float32.
ENERGY_TOLERANCE = 1e-6


def published_reference(scene: Scene, folder: str | Path, *, progress: bool = False) -> Reference:
    """The released test cases in ``folder``, for a scene that is the released model.

    Where the release has no displacements, our FEM solves at the released theta, and its energies
    must equal the released ones.

    Raises
    ------
    InputError
        Another scene, or an energy more than ``ENERGY_TOLERANCE`` away.
    """
    folder = Path(folder).resolve()
    model = folder.name
    released = published_scene(model, folder.parent)
    if not released.identity.agrees(scene.identity):
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
