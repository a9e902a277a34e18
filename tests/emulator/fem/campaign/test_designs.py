"""Designs in the box."""

import numpy as np
import pytest

import emulator as em
from emulator.fem import design, sobol


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
