"""Designs in the box, and reference solutions inside and outside it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem import design, sobol
from emulator.fem.campaign.designs import fem_reference, outside_reference, sample_outside
from emulator.fem.solution import Status
from emulator.scenes import Parameter, Scene
from scene_support import LAM, MU, hanging_block


def test_a_shorter_design_begins_a_longer_one(beam):
    long = design(beam, 40, seed=3)
    for count in (1, 4, 5, 17, 39):
        np.testing.assert_array_equal(design(beam, count, seed=3), long[:count])


def test_every_corner_is_in_a_design_long_enough(beam):
    positions = np.round(np.asarray(beam.to_unit(design(beam, 20, seed=0))), 9)
    corners = {tuple(row) for row in positions if set(row) <= {0.0, 1.0}}
    assert corners == {(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)}
    assert len(np.unique(positions, axis=0)) == 20


def test_many_parameters_have_too_many_corners():
    scene = em.find_scene("left_ventricle_segments")
    np.testing.assert_allclose(design(scene, 12, 0), sobol(scene, 12, 0), rtol=1e-12)


@pytest.mark.parametrize(("count", "seed"), [(0, 0), (3, -1)])
def test_a_design_of_nothing(beam, count, seed):
    with pytest.raises(em.InputError, match="samples with seed"):
        sobol(beam, count, seed)


@pytest.fixture(scope="module")
def hanging() -> Scene:
    return hanging_block()


@pytest.fixture(scope="module")
def simulator(hanging):
    return em.Simulator(hanging)


@pytest.fixture(scope="module")
def out_of_balance(simulator):
    return jax.jit(simulator.system.relative_residual)


def test_outside_the_box(hanging):
    thetas = np.asarray(sample_outside(hanging, 40, 0.25))
    position = np.asarray(hanging.to_unit(jnp.asarray(thetas)))
    assert thetas.shape == (40, 2)
    assert ((position < 0.0) | (position > 1.0)).any(axis=1).all()
    assert position.min() >= -0.25
    assert position.max() <= 1.25
    assert (position.min() < -0.15) & (position.max() > 1.15)
    # A uniform range widened past zero, and a Poisson ratio past a half, hold values to leave out.
    near = replace(hanging, parameters=(Parameter("mu", "kPa", 1.0, 3.0), LAM))
    assert np.asarray(sample_outside(near, 40, 1.0))[:, 0].min() > 0.0
    nu = np.asarray(sample_outside(em.scenes.twisting_cube(cells=1, order=1), 40, 0.5))[:, 1]
    assert 0.45 < nu.max() < 0.5
    with pytest.raises(InputError, match="outside is -1"):
        sample_outside(hanging, 4, -1.0)


@pytest.mark.slow
def test_solves_that_fail_outside_are_counted(hanging, simulator, out_of_balance):
    class Brittle(em.Simulator):
        def solve(self, theta, start=None):
            solution = super().solve(theta, start)
            soft = jnp.where(theta[0] < MU.low, Status.LOAD_LIMIT, solution.status)
            return solution._replace(status=soft)

    brittle = Brittle(hanging)
    vars(brittle).update(_equilibrium=simulator._equilibrium)  # compiled already
    found = outside_reference(brittle, 8, 0.25, fem_reference(brittle, 2))
    soft = int((np.asarray(sample_outside(hanging, 8, 0.25))[:, 0] < MU.low).sum())
    assert 0 < soft < 8
    assert found.failed == soft
    assert len(found.thetas) == len(found.displacement) == 8 - soft
    assert found.thetas[:, 0].min() >= MU.low
    assert out_of_balance(found.displacement[0], found.thetas[0]) < 1e-8


def test_outside_the_box_of_a_scene_with_regions():
    segments = em.scenes.left_ventricle_segments(rings=6, around=12, layers=1, order=1)
    thetas = sample_outside(segments, 5, 0.25)
    assert thetas.shape == (5, 18)
    assert float(jnp.min(thetas)) > 0.0
