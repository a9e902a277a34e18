import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.discretisation import dihedral_angles
from emulator.geometry.generators.ellipsoid import (
    HUMAN,
    LAND,
    EllipsoidalWall,
    human_ventricle,
    land_ventricle,
    truncated_ellipsoid,
)
from geometry_support import assert_sound, order_of, volume


@pytest.mark.parametrize("order", [1, 2])
def test_a_ventricle_is_sound(order):
    assert_sound(truncated_ellipsoid(LAND, rings=6, around=14, layers=2, order=order))


def test_the_human_ventricle_is_well_shaped_and_of_human_size():
    mesh = human_ventricle()
    assert_sound(mesh)
    assert 1400 < len(mesh.nodes) < 1600
    angles = dihedral_angles(mesh)
    assert angles.min() > 20.0
    assert angles.max() < 135.0
    assert 90e3 < HUMAN.cavity_volume < 100e3


def test_the_dimensions_are_lands():
    mesh = land_ventricle()
    inside, outside = (
        mesh.nodes[mesh.node_set(f"apex_{name}")] for name in ("endocardium", "epicardium")
    )
    np.testing.assert_allclose(inside, [[0.0, 0.0, -17.0]], atol=1e-12)
    np.testing.assert_allclose(outside, [[0.0, 0.0, -20.0]], atol=1e-12)
    np.testing.assert_allclose(mesh.nodes[mesh.node_set("base"), 2], 5.0)


@pytest.mark.parametrize("order", [1, 2])
def test_surface_nodes_lie_on_the_ellipsoids(order):
    mesh = land_ventricle(order=order)
    for name, short, long in (("endocardium", 7.0, 17.0), ("epicardium", 10.0, 20.0)):
        x, y, z = mesh.nodes[np.unique(mesh.facet_set(name))].T
        np.testing.assert_allclose((x**2 + y**2) / short**2 + z**2 / long**2, 1.0)
    np.testing.assert_allclose(mesh.nodes[np.unique(mesh.facet_set("base")), 2], 5.0)
    assert set(np.unique(mesh.facet_set("base"))) == set(mesh.node_set("base"))


@pytest.mark.parametrize(("order", "expected"), [(1, 1.9), (2, 3.9)])
def test_volume_converges(order, expected):
    errors = [
        volume(truncated_ellipsoid(LAND, 4 * n, 12 * n, n, order)) / LAND.volume - 1.0
        for n in (1, 2, 4)
    ]
    assert order_of(np.array(errors)).min() > expected


@pytest.mark.parametrize("order", [1, 2])
def test_graded_rings_are_closer_at_the_base(order):
    even, graded = (truncated_ellipsoid(LAND, 6, 14, 2, order, grading=g) for g in (1.0, 1.5))
    assert_sound(graded)
    for mesh in (even, graded):
        assert volume(mesh) == pytest.approx(LAND.volume, rel=0.06 if order == 1 else 5e-3)
    # The next ring below the base, of 6: a sixth of the way, or (1/6)^1.5.
    first = [
        5.0 - np.unique(mesh.nodes[mesh.facet_set("epicardium")[:, :3], 2].round(6))[-2]
        for mesh in (even, graded)
    ]
    assert first[1] < 0.6 * first[0]


def test_volume_by_quadrature():
    # Disc by disc: pi (outer^2 - inner^2) over height, from each surface's apex to the base.
    def below(short, long):
        z = np.linspace(-long, 5.0, 20001)
        return np.trapezoid(np.pi * short**2 * (1.0 - z**2 / long**2), z)

    assert LAND.cavity_volume == pytest.approx(below(7.0, 17.0), rel=1e-6)
    assert LAND.volume == pytest.approx(below(10.0, 20.0) - below(7.0, 17.0), rel=1e-6)


def test_bad_dimensions_are_named():
    with pytest.raises(InputError, match="semi-axes .*expected the endocardium's above zero"):
        EllipsoidalWall(10.0, 17.0, 7.0, 20.0, 5.0)
    with pytest.raises(InputError, match="base plane at 17.0 mm; expected between"):
        EllipsoidalWall(7.0, 17.0, 10.0, 20.0, 17.0)
    with pytest.raises(InputError, match="1 rings of 24 points"):
        land_ventricle(rings=1)
    with pytest.raises(InputError, match="0 layers"):
        land_ventricle(layers=0)
    for grading in (0.0, -1.0, float("inf")):
        with pytest.raises(InputError, match="grading .* of the rings; expected above 0"):
            truncated_ellipsoid(LAND, 6, 14, 2, grading=grading)
    with pytest.raises(InputError, match="order 3; expected 1 or 2"):
        land_ventricle(order=3)
