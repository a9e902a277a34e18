import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.discretisation import dihedral_angles
from emulator.geometry.generators.sphere import organ
from geometry_support import assert_sound, order_of, volume


@pytest.mark.parametrize("order", [1, 2])
def test_an_organ_is_sound(order):
    assert_sound(organ(shells=3, order=order), patches=("ligament",))


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
    exact = 4.0 / 3.0 * np.pi * np.prod(half_axes) * (1.0 + 0.35 * 0.5 / 5.0)
    errors = [volume(organ(half_axes, n, order)) / exact - 1.0 for n in (2, 4)]
    assert order_of(np.array(errors)).min() > expected


@pytest.mark.parametrize("order", [1, 2])
def test_a_clustered_organ_is_sound_and_as_large(order):
    even, clustered = (organ(shells=3, order=order, clustering=c) for c in (0.0, 0.5))
    assert_sound(clustered, patches=("ligament",))
    assert volume(clustered) == pytest.approx(volume(even), rel=0.15 if order == 1 else 0.03)
    assert dihedral_angles(clustered).min() > 10.0


def test_elements_are_smaller_at_the_ligament():
    """By (1 - c) / (1 + c) in the middle of it, a third for c = 1/2, and by 0.4 over all of it."""
    edges = []
    for clustering in (0.0, 0.5):
        mesh = organ(shells=6, clustering=clustering)
        corners = mesh.nodes[mesh.facet_set("ligament")]
        edges.append(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)))
    assert 1.0 / 3.0 < edges[1] / edges[0] < 0.45


def test_bad_dimensions_are_named():
    with pytest.raises(InputError, match=r"half axes \(1.0, 0.0, 1.0\) mm must be positive"):
        organ((1.0, 0.0, 1.0))
    with pytest.raises(InputError, match="1 shells; expected at least 2"):
        organ(shells=1)
    for clustering in (-0.1, 1.0, float("nan")):
        with pytest.raises(InputError, match="clustering .*; expected from 0 to below 1"):
            organ(clustering=clustering)
