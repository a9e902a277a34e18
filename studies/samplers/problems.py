"""Posteriors that samplers are compared on: what is observed of a ventricle, and other bodies."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

import calibrate as cal
import emulator as em
from calibrate.measurements import parse_observation
from calibrate.statistical_model import Model
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.protocol import ForwardMap
from emulator.surrogates.taylor import expand

VENTRICLE = "left_ventricle"
TRUTH = 0.4  # position of every true parameter in its range


@dataclass(frozen=True)
class Problem:
    """A scene's posterior.

    observe : the observation, as on the command line. noise : the sd of each observed quantity.
    states : the names of load states. known : parameters that are not inferred.
    shipped : whether the scene's map is its shipped emulator; else a series of order 2.
    """

    scene: str
    observe: str
    noise: dict[str, float]
    states: tuple[str, ...] = ("",)
    known: tuple[tuple[str, float], ...] = ()
    shipped: bool = True

    def forward(self) -> ForwardMap:
        """Return the scene's map."""
        if self.shipped:
            return em.load(self.scene, kind="series").cache()
        scene = em.find_scene(self.scene)
        return Emulator(scene, taylor=expand(em.Simulator(scene), order=2)).cache()


def _points(scene: str, noise: float, *, shipped: bool = True) -> Problem:
    return Problem(scene, "landmarks:20", {"displacement": noise}, shipped=shipped)


PRESSURES = {"low": 0.6, "middle": 0.9, "high": 1.2}  # kPa
OBSERVED = {
    "one volume": Problem(VENTRICLE, "volume", {"volume": 1.0}),
    "three volumes at known pressures": Problem(
        VENTRICLE,
        "volume",
        {"volume": 1.0},
        states=tuple(PRESSURES),
        known=tuple((f"pressure@{state}", value) for state, value in PRESSURES.items()),
    ),
    "24 landmarks": Problem(VENTRICLE, "landmarks:24", {"displacement": 0.3}),
    "fibre strain at 10 places": Problem(VENTRICLE, "strain:fibre:10", {"strain": 0.02}),
    "24 landmarks and volume": Problem(
        VENTRICLE, "landmarks:24+volume", {"displacement": 0.3, "volume": 1.0}
    ),
}
BODIES = {
    "beam": _points("once_clamped_beam", 0.2),
    "cube": _points("twisting_cube", 0.005),
    "liver": _points("liver", 0.3),
    "beam under a turning weight": _points("turned_beam", 0.2, shipped=False),
    "Guccione's beam": _points("traction_beam_guccione", 0.05, shipped=False),
    "Holzapfel and Ogden's beam": _points("traction_beam_holzapfel_ogden", 0.05, shipped=False),
    "neo-Hookean ventricle": _points("left_ventricle_neo_hookean", 0.3, shipped=False),
}
PROBLEMS = OBSERVED | BODIES


def problem(name: str, seed: int) -> tuple[Model, dict[str, Any]]:
    """Return the model, and data of it with noise, at a theta near the centre of the box."""
    asked = PROBLEMS[name]
    forward = asked.forward()
    scene = forward.scene
    parts = parse_observation(scene, asked.observe, seed, asked.states)
    levels = {
        part: cal.GaussianNoise(sd=asked.noise[part.partition("@")[0]]) for part in parts.parts
    }
    model = cal.model(forward, parts, levels, known=dict(asked.known))
    centre = dict(
        zip(
            scene.parameter_names,
            scene.from_unit(jnp.full(len(scene.parameters), TRUTH)),
            strict=True,
        )
    )
    truth = {unknown: centre[unknown] for unknown in model.names}
    data, _ = model.predict(truth)
    rng = np.random.default_rng(seed)
    return model, {
        part: np.asarray(data[part]) + levels[part].sd * rng.normal(size=np.shape(data[part]))
        for part in parts.parts
    }
