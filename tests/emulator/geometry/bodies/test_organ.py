import numpy as np
import pytest

from emulator.errors import InputError
from emulator.geometry.bodies.organ import organ
from emulator.geometry.bodies.organ import volume as exact
from geometry_support import assert_sound, dihedral_angles, order_of, volume


@pytest.mark.parametrize("order", [1, 2])
def test_an_organ_is_sound(order):
    assert_sound(organ(shells=3, order=order))


def test_the_usual_organ_is_well_shaped_and_held_at_a_patch_of_its_surface():
    mesh = organ()
    assert len(mesh.nodes) == 923
    assert dihedral_angles(mesh).min() > 12.0
    held = mesh.node_set("ligament")
    assert 20 < len(held) < 40
    assert set(held) < set(np.unique(mesh.facet_set("surface")))


@pytest.mark.parametrize(("order", "expected"), [(1, 1.8), (2, 3.8)])
def test_volume_converges(order, expected):
    half_axes = (3.0, 2.0, 1.0)
    errors = [volume(organ(half_axes, n, order)) / exact(half_axes) - 1.0 for n in (2, 4)]
    assert order_of(np.array(errors)).min() > expected


def test_bad_dimensions_are_named():
    with pytest.raises(InputError, match=r"half axes \(1.0, 0.0, 1.0\) mm must be positive"):
        organ((1.0, 0.0, 1.0))
    with pytest.raises(InputError, match="1 shells; expected at least 2"):
        organ(shells=1)
