import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.discretisation import dihedral_angles
from emulator.geometry.generators.biventricle import RightVentricle, Septum, biventricle
from emulator.geometry.generators.ellipsoid import HUMAN
from geometry_support import assert_sound, order_of, volume


@pytest.mark.parametrize("order", [1, 2])
def test_two_ventricles_are_sound(order):
    assert_sound(biventricle(rings=8, around=16, layers=(2, 1), order=order))


def test_the_usual_biventricle_is_well_shaped():
    mesh = biventricle()
    assert_sound(mesh)
    assert 1500 < len(mesh.nodes) < 2500
    angles = dihedral_angles(mesh)
    assert angles.min() > 7.0
    assert angles.max() < 150.0
    np.testing.assert_allclose(mesh.nodes[mesh.node_set("base"), 2], HUMAN.base)


@pytest.mark.parametrize("order", [1, 2])
def test_surfaces_lie_on_the_left_ventricles_where_they_are_its_own(order):
    mesh = biventricle(rings=8, around=16, layers=(2, 1), order=order)
    for name, short, long, share in (
        ("lv_endocardium", HUMAN.short_endocardium, HUMAN.long_endocardium, 1.0),
        ("rv_endocardium", HUMAN.short_epicardium, HUMAN.long_epicardium, 0.3),
        ("epicardium", HUMAN.short_epicardium, HUMAN.long_epicardium, 0.3),
    ):
        x, y, z = mesh.nodes[np.unique(mesh.facet_set(name))].T
        out = (x**2 + y**2) / short**2 + z**2 / long**2 - 1.0
        assert out.min() > -1e-9
        assert np.mean(np.abs(out) < 1e-9) >= share


@pytest.fixture(scope="module")
def exact_volume():
    """The left wall's, and the free wall's by quadrature of its map's determinant."""
    septum = Septum(HUMAN, RightVentricle())

    def derivative(axis, points, step=1e-6):
        shift = step * np.eye(3)[axis][:, None]
        return (septum.sheet(*(points + shift)) - septum.sheet(*(points - shift))) / (2.0 * step)

    # Unequal counts keep the midpoints off the lines where the map has kinks.
    across, up = (np.arange(101) + 0.5) / 101.0, (np.arange(112) + 0.5) / 112.0
    depths, weights = np.polynomial.legendre.leggauss(3)
    free_wall = 0.0
    for s, weight in zip(0.5 + 0.5 * depths, 0.5 * weights, strict=True):
        points = np.stack(np.meshgrid(2.0 * across - 1.0, up, [s])).reshape(3, -1)
        columns = np.stack([derivative(axis, points) for axis in range(3)], axis=-1)
        free_wall += weight * 2.0 * np.abs(np.linalg.det(columns)).mean()
    return HUMAN.volume + free_wall


@pytest.mark.parametrize(("order", "expected"), [(1, 1.8), (2, 3.5)])
def test_volume_converges(exact_volume, order, expected):
    errors = [
        volume(biventricle(rings=8 * n, around=16 * n, layers=(n, n), order=order)) / exact_volume
        for n in (1, 2)
    ]
    assert order_of(np.array(errors) - 1.0)[0] > expected


def test_bad_dimensions_are_named():
    with pytest.raises(InputError, match=r"layers through the walls; expected at least 1"):
        biventricle(layers=(2, 0))
    with pytest.raises(
        InputError, match="7 rings of 36 leave no grid .*at least 8 around and 8 rings"
    ):
        biventricle(rings=7, around=36)
