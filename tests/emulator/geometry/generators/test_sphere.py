import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.discretisation import dihedral_angles
from emulator.geometry.generators.sphere import sphere_octant
from geometry_support import assert_sound, order_of, volume


@pytest.mark.parametrize("order", [1, 2])
def test_an_octant_is_sound_and_its_sets_lie_where_they_say(order):
    mesh = sphere_octant(1.0, 2.0, (4, 2), grading=1.5, order=order)
    assert_sound(mesh)
    assert dihedral_angles(mesh).min() > 25.0
    for axis, name in enumerate("xyz"):
        assert set(mesh.node_set(name)) == set(np.unique(mesh.facet_set(name)))
        np.testing.assert_allclose(mesh.nodes[mesh.node_set(name), axis], 0.0, atol=1e-15)
    for name, radius in (("inner", 1.0), ("outer", 2.0)):
        np.testing.assert_allclose(np.linalg.norm(mesh.nodes[mesh.node_set(name)], axis=1), radius)


@pytest.mark.parametrize(("order", "expected"), [(1, 1.7), (2, 3.7)])
def test_volume_converges(order, expected):
    exact = np.pi / 6.0 * (2.0**3 - 1.0)
    errors = [
        volume(sphere_octant(1.0, 2.0, (2 * n, n), order=order)) / exact - 1.0 for n in (1, 2, 4)
    ]
    assert order_of(np.array(errors)).min() > expected


def test_grading_is_the_ratio_of_the_outermost_layer_to_the_innermost():
    mesh = sphere_octant(1.0, 2.0, (1, 3), grading=4.0)
    thickness = np.diff(np.unique(np.round(np.linalg.norm(mesh.nodes, axis=1), 12)))
    np.testing.assert_allclose(thickness, np.array([1.0, 2.0, 4.0]) / 7.0)


def test_bad_dimensions_are_named():
    with pytest.raises(InputError, match="radii 2.0 and 1.0 mm; expected 0 < inner < outer"):
        sphere_octant(2.0, 1.0, (2, 2))
    with pytest.raises(InputError, match=r"cells \(0, 2\) and grading 1.0 must be positive"):
        sphere_octant(1.0, 2.0, (0, 2))
