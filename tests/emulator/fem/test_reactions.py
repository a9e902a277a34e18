"""Supports balance the loads; hand arithmetic where there is any."""

from dataclasses import replace

import numpy as np
import pytest

import emulator as em
from emulator.scenes import Support
from emulator.scenes.loads import Gravity, Traction
from emulator.scenes.supports.elastic import ElasticSupport
from scene_support import block


def solved(scene, theta=None):
    simulator = em.Simulator(scene)
    theta = scene.centre if theta is None else theta
    return simulator, simulator.solve(theta).require_converged().displacement, theta


def test_a_clamp_carries_the_weight(beam, simulator):
    theta = beam.centre
    u = simulator(theta)
    field = np.asarray(simulator.reactions(u, theta))
    (gravity,) = beam.loads
    assert isinstance(gravity, Gravity)
    # g/cm3 times mm3 is mg; times m/s2, 1e-3 mN.
    volume = float(beam.discretisation.weights.sum())
    weight = 1e-3 * gravity.density * gravity.acceleration * volume
    downwards = np.asarray(gravity.direction) / np.linalg.norm(gravity.direction)
    np.testing.assert_allclose(field.sum(axis=0), -weight * downwards, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(field[~beam.held], 0.0)
    np.testing.assert_allclose(simulator.reaction("left", u, theta), field.sum(axis=0))


@pytest.mark.slow
def test_a_ventricles_base_carries_the_pressure_on_its_lid(ventricle):
    """The cavity's wall and a lid over its rim are closed: pressure on both has no resultant."""
    simulator, u, theta = solved(ventricle)
    pressure = float(theta[ventricle.parameter_names.index("pressure")])
    facets = ventricle.mesh.facet_set("endocardium")
    corners = ventricle.mesh.nodes[facets][:, :3]
    wall = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
    # Facets face out of the tissue and the rim is held, so this sum is that of the deformed wall.
    force = simulator.reaction("base", u, theta)
    np.testing.assert_allclose(force, pressure * wall, rtol=1e-8, atol=1e-6)


@pytest.mark.slow
def test_springs_are_supports():
    plain = block()
    supports = (ElasticSupport("left", 2.0), Support("bottom", components="z"))
    scene = replace(plain, supports=supports, loads=(Traction("right", (0.3, 0.1, 0.2)),))
    simulator, u, theta = solved(scene)
    # 0.3, 0.1 and 0.2 kPa on a face of 3 by 4 mm.
    total = np.asarray(simulator.reactions(u, theta)).sum(axis=0)
    np.testing.assert_allclose(total, [-3.6, -1.2, -2.4], atol=1e-6)
    both = simulator.reaction("left", u, theta)[:2]
    np.testing.assert_allclose(both, [-3.6, -1.2], atol=1e-6)  # the other slides in x and y
