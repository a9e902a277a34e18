"""The benchmark's data sets: a passive left ventricle, what is measured of it, and its model.

Data are ``data/<name>.json``: values, noise, positions, priors and the truth. They are made once,
by FEM and NumPy's generator, and never again.
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from studies.common.output import write_json

import calibrate as cal
import emulator as em

DATA = Path(__file__).parent / "data"
SEED = 2026
SCENE = "left_ventricle"
FINER = (20, 40, 4)  # rings, around, layers of the mesh that one data set is made on
POINTS = 24
COMPONENTS = ("circumferential", "longitudinal")
SD = {"displacement": 0.3, "volume": 1.0, "strain": 0.01}  # mm, mL, 1; of the middle level
LEVELS = {"low": 0.5, "mid": 1.0, "high": 2.0}
KINDS = {
    "volume": ("volume",),
    "displacements": ("displacement",),
    "strains": ("strain",),
    "all": ("displacement", "volume", "strain"),
}


@dataclass(frozen=True)
class Problem:
    """One data set: what is measured, its noise's level, whether on a finer mesh."""

    kind: str
    level: str
    finer: bool = False

    @property
    def name(self) -> str:
        return f"{self.kind}_{'finer' if self.finer else self.level}"

    @property
    def measured(self) -> tuple[str, ...]:
        return KINDS[self.kind]

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviation of each measurement's noise."""
        return {name: SD[name] * LEVELS[self.level] for name in self.measured}


PROBLEMS = {
    problem.name: problem
    for problem in (
        *(Problem(kind, level) for kind in KINDS for level in LEVELS),
        Problem("all", "mid", finer=True),
    )
}


@lru_cache
def scene_of(*, finer: bool = False) -> em.Scene:
    """The ventricle of linear elements; the model's, or the finer one that data are made on."""
    return em.scenes.left_ventricle(*(FINER if finer else ()), order=1)


def observed(problem: Problem, scene: em.Scene) -> cal.Observations:
    """What is measured, at the same material points of either mesh."""
    at = cal.spread_landmarks(scene_of(), POINTS, SEED)
    made = {
        "displacement": lambda: cal.landmarks(scene, at),
        "volume": lambda: cal.CavityVolume(scene),
        "strain": lambda: cal.strains(scene, COMPONENTS, at),
    }
    return cal.Observations({name: made[name]() for name in problem.measured})


def model(problem: Problem, forward: em.ForwardMap) -> cal.Model:
    """The statistical model: ``forward``, independent Gaussian noise, the scene's priors."""
    noise = {name: cal.GaussianNoise(sd) for name, sd in problem.sd.items()}
    return cal.model(forward, observed(problem, forward.scene), noise)


def make(problem: Problem) -> dict[str, Any]:
    """A data set: theta from the prior, FEM's measurements of it, and noise."""
    scene = scene_of(finer=problem.finer)
    rng = np.random.default_rng([SEED, *problem.name.encode()])
    theta = scene.from_unit(jnp.asarray(rng.uniform(0.1, 0.9, len(scene.parameters))))
    displacement = em.Simulator(scene).solve(theta).require_converged(problem.name).displacement
    observe = observed(problem, scene)
    exact = observe(displacement[None, observe.nodes], theta[None])
    values = {n: np.asarray(v) + problem.sd[n] * rng.normal(size=v.shape) for n, v in exact.items()}
    return {
        "name": problem.name,
        "scene": SCENE,
        "finer_mesh": problem.finer,
        "parameters": [
            {"name": p.name, "unit": p.unit, "low": p.low, "high": p.high, "prior": p.scale}
            for p in scene.parameters
        ],
        "positions_mm": np.round(cal.spread_landmarks(scene_of(), POINTS, SEED), 9).tolist(),
        "components": list(COMPONENTS),
        "noise_sd": problem.sd,
        "data": {name: value.tolist() for name, value in values.items()},
        "truth": dict(zip(scene.parameter_names, np.asarray(theta).tolist(), strict=True)),
    }


def data_of(problem: Problem) -> dict[str, np.ndarray]:
    """The data, made and written if there are none."""
    path = DATA / f"{problem.name}.json"
    if not path.is_file():
        DATA.mkdir(exist_ok=True)
        write_json(path, make(problem))
    found = json.loads(path.read_text())["data"]
    return {name: np.asarray(value) for name, value in found.items()}
