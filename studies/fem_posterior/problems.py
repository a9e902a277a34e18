"""The problems: a scene, an emulator of it, and data made by FEM."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

import emulator as em
from calibrate.project import Run, by_fem, make_data, simulator_of
from calibrate.statistical_model import Model
from calibrate.statistical_model.model import model
from emulator.fem import Simulator
from emulator.scenes import Scene
from emulator.surrogates.protocol import ForwardMap, Prediction
from emulator.training import recipe, train

SEED = 7
VENTRICLE = {
    "truth": {"a": 0.33, "b": 2.2, "a_f": 6.0, "b_f": 2.4, "pressure": 1.0},
    "observe": "landmarks:24+volume",
    "noise": {"displacement": 0.3, "volume": 1.0},
}
COARSE = {"rings": 4, "around": 8, "layers": 1, "order": 1}


class Counted:
    """A forward map that counts its evaluations, inside compiled programs too."""

    def __init__(self, base: ForwardMap) -> None:
        self.base, self.count = base, 0
        self.kind, self.label, self.scene = base.kind, base.label, base.scene
        self.nodes, self.fingerprint = base.nodes, base.fingerprint

    def _add(self) -> None:
        self.count += 1

    def total(self) -> int:
        """Evaluations so far; what runs is waited for."""
        jax.effects_barrier()
        return self.count

    def evaluate(self, theta: jax.Array) -> Prediction:
        jax.debug.callback(self._add)
        return self.base.evaluate(theta)

    def __call__(self, theta: jax.Array) -> jax.Array:
        return self.evaluate(theta).displacement

    def at(self, nodes: np.ndarray) -> "Counted":
        return Counted(self.base.at(nodes))


@dataclass(frozen=True, eq=False)
class Problem:
    """A posterior to sample, with the emulator and with FEM.

    cheap : the model with the emulator. fem : with FEM, Newton's method starting from the
    emulator's prediction; ``solves`` is its forward map and counts.
    """

    name: str
    scene: Scene
    simulator: Simulator
    data: dict[str, np.ndarray]
    cheap: Model
    fem: Model
    solves: Counted

    @property
    def nodes(self) -> int:
        return len(self.scene.mesh.nodes)


def _problem(name: str, scene: Scene, forward: ForwardMap, words: dict[str, Any]) -> Problem:
    run = Run(scene.name, seed=SEED, **words)
    observe, data = make_data(run, scene)
    cheap = model(forward, observe, run.noises(observe))
    fem = by_fem(cheap)
    counted = Counted(fem.forward)
    # The data is FEM's own; asking whether it is of the right size would cost solves.
    fem = replace(fem, forward=counted, check_scale=False)
    return Problem(name, scene, simulator_of(scene), data, cheap, fem, counted)


def _beam() -> Problem:
    words = {"truth": {"mu": 72.0, "lam": 68.0}, "observe": "nodes:20", "noise": 0.2}
    scene = em.find_scene("once_clamped_beam")
    return _problem("beam", scene, em.load("once_clamped_beam", kind="series").cache(), words)


def _cube() -> Problem:
    words = {"truth": {"E": 9.0, "nu": 0.28}, "observe": "landmarks:20", "noise": 0.05}
    scene = em.find_scene("twisting_cube")
    return _problem("cube", scene, em.load("twisting_cube", kind="series").cache(), words)


def _coarse() -> Problem:
    scene = em.scenes.left_ventricle(**COARSE)
    with tempfile.TemporaryDirectory() as folder:
        forward = train(scene, recipe("mechanics"), folder).cache()
    return _problem("coarse ventricle", scene, forward, VENTRICLE)


def _ventricle() -> Problem:
    scene = em.find_scene("left_ventricle")
    return _problem("ventricle", scene, em.load("left_ventricle", kind="series").cache(), VENTRICLE)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "beam": _beam,
    "cube": _cube,
    "coarse": _coarse,
    "ventricle": _ventricle,
}
