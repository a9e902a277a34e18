import numpy as np
import pytest

from emulator.geometry.generators.ellipsoid import disc


@pytest.mark.parametrize("around", [6, 13, 24])
def test_triangles_are_anticlockwise_and_fill_the_polygon(around):
    radius, angle, triangles = disc(5, around)
    corner = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])[triangles]
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    areas = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert areas.min() > 0.0
    assert areas.sum() == pytest.approx(0.5 * around * np.sin(2.0 * np.pi / around))


def test_rings_grow_by_six():
    _, counts = np.unique(disc(5, 20)[0], return_counts=True)
    np.testing.assert_array_equal(counts, [1, 6, 12, 18, 20, 20])


def test_the_disc_is_its_own_mirror_image():
    radius, angle, triangles = disc(5, 18)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    mirrored = points * [1.0, -1.0]
    image = np.argmin(np.linalg.norm(points[None] - mirrored[:, None], axis=2), axis=1)
    assert {frozenset(row) for row in image[triangles].tolist()} == {
        frozenset(row) for row in triangles.tolist()
    }
