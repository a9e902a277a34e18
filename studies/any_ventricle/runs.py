"""FEM runs of the ventricles to learn from, one file a body; what is there is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc
from studies.any_ventricle.shapes import ORDINARY, PARAMETERS, THIN, Body, Kind, bodies
from studies.common.arrays import read_arrays, save_arrays
from tqdm import tqdm

import emulator as em

MOST = 1024
"""The number of bodies of a group of which the first so many are taken."""
RUNS_A_BODY = 4


@dataclass(frozen=True)
class Group:
    """Bodies of one kind to learn from: their kind, seed and share of irregular ones."""

    kind: Kind
    seed: int
    irregular: float

    def bodies(self) -> list[Body]:
        """The bodies in their order."""
        return bodies(MOST, self.seed, self.irregular, self.kind)


GROUPS = {"ordinary": Group(ORDINARY, 0, 0.5), "thin": Group(THIN, 7, 0.7)}
"""The groups by name, which is that of the folder their runs lie in."""
_CLEARED = 50  # bodies after which compiled programs are dropped

_kept: dict[Any, em.Simulator] = {}  # one a topology, so that bodies share its programs


def body_runs(
    folder: Path, group: str, numbers: Sequence[int], *, progress: bool = False
) -> list[em.families.BodyRuns]:
    """The runs of the bodies ``numbers`` of a group with FEM's slopes in the unit box.

    folder : where the group's folder is. What is not there is solved.
    """
    folder = folder / group
    folder.mkdir(parents=True, exist_ok=True)
    made = GROUPS[group].bodies()
    bits = (MOST * RUNS_A_BODY - 1).bit_length()
    points = qmc.Sobol(len(PARAMETERS), rng=GROUPS[group].seed + 1000).random_base2(bits)
    found = []
    for k in tqdm(numbers, "bodies", disable=not progress):
        path, scene = folder / f"{k:04d}.safetensors", made[k].scene()
        if not path.is_file():
            if k % _CLEARED == 0:
                _kept.clear()
                jax.clear_caches()
            save_arrays(path, _solved(scene, points[k * RUNS_A_BODY : (k + 1) * RUNS_A_BODY]))
        arrays, _ = read_arrays(path)
        if len(arrays["position"]) == RUNS_A_BODY:  # equally many of each
            held = scene.held.all(axis=1)
            found.append(
                em.families.BodyRuns(em.families.describe(scene), scene.mesh, held, **arrays)
            )
    return found


def _solved(scene: em.Scene, positions: np.ndarray) -> dict[str, np.ndarray]:
    """Displacements and slopes of one body; runs that fail are left out."""
    simulator = em.Simulator(scene)
    _kept.setdefault(scene.mesh.elements.tobytes(), simulator)
    of_box = jax.jacfwd(scene.from_unit)
    kept: dict[str, list[np.ndarray]] = {"position": [], "displacement": [], "slopes": []}
    for x in positions:
        theta = scene.from_unit(jnp.asarray(x))
        solution = simulator.solve(theta)
        if not bool(solution.converged):
            continue
        by_theta = simulator.sensitivities(solution.displacement, theta)
        slopes = jnp.einsum("pni,pq->qni", by_theta, of_box(jnp.asarray(x)))
        kept["position"].append(x)
        kept["displacement"].append(np.asarray(solution.displacement, np.float32))
        kept["slopes"].append(np.asarray(slopes, np.float32))
    return {name: np.asarray(values) for name, values in kept.items()}
