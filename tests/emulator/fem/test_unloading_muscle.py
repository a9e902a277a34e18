"""Muscle that pulls in the image: its tension is taken off with the pressure."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.scenes.loads import ActiveTension

MET = 1e-8  # mm
TENSION = 12.0  # kPa


def contracting(transverse, **image):
    scene = em.scenes.left_ventricle(3, 6, 1, order=1)
    tension = em.Parameter("tension", "kPa", 0.0, 40.0)
    loads = (*scene.loads, ActiveTension(transverse=transverse))
    return replace(scene, loads=loads, parameters=(*scene.parameters, tension), origin={}, **image)


def at(scene, **values):
    centre = dict(zip(scene.parameter_names, scene.centre.tolist(), strict=True))
    return scene.theta(**{**centre, **values})


@pytest.mark.slow
@pytest.mark.parametrize("transverse", [0.0, 0.3])
def test_the_unloaded_shape_loaded_from_rest_is_the_mesh(transverse):
    """The force on the loaded shape and the potential from rest are two ways to one stress."""
    scene = contracting(transverse)
    theta = at(scene, pressure=1.0, tension=TENSION)
    unloaded = em.fem.unload(scene, theta).require_converged()
    again = em.Simulator(unloaded.scene).solve(theta).require_converged()
    np.testing.assert_allclose(again.displacement, unloaded.start, atol=MET)
    passive = em.fem.unload(scene, at(scene, pressure=1.0, tension=0.0)).require_converged()
    assert float(jnp.abs(passive.displacement - unloaded.displacement).max()) > 0.1


@pytest.mark.slow
def test_a_heart_imaged_at_rest_contracts():
    """Unloaded without tension, then loaded with it, differentiably; by hand in two steps."""
    plain = contracting(0.0)
    scene = contracting(
        0.0,
        loaded_by={"pressure": "imaged", "tension": "slack"},
        constants={**plain.constants, "imaged": 0.8, "slack": 0.0},
    )
    theta = at(scene, pressure=1.3, tension=TENSION)
    simulator = em.Simulator(scene)
    found = simulator.solve(theta).require_converged()
    unloaded = em.fem.unload(plain, at(plain, pressure=0.8, tension=0.0)).require_converged()
    by_hand = em.Simulator(unloaded.scene).solve(at(plain, pressure=1.3, tension=TENSION))
    right = unloaded.displacement + by_hand.require_converged().displacement
    np.testing.assert_allclose(found.displacement, right, atol=MET)
    step, direction = 1e-3, jnp.zeros(len(theta)).at[-1].set(1.0)
    slope = simulator.sensitivities(found.displacement, theta)[-1]
    high, low = (simulator(theta + sign * step * direction) for sign in (1.0, -1.0))
    np.testing.assert_allclose(slope, (high - low) / (2 * step), atol=1e-6 * jnp.abs(slope).max())
