import numpy as np
import pytest

from emulator.geometry.generators.biventricle import open_sheet, spread
from emulator.geometry.generators.ellipsoid import disc


def square(n=4):
    """Unit square of n x n cells cut in two: points (v, 2), triangles (k, 3)."""
    x, y = np.meshgrid(np.arange(n + 1) / n, np.arange(n + 1) / n, indexing="ij")
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    triangles = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    return np.column_stack([x.ravel(), y.ravel()]), np.concatenate(triangles)


def test_an_opened_sheet_has_its_line_once_for_each_level():
    points, triangles = square()
    inside = points[:, 0] > 0.4  # the line is x = 0.5
    opened = open_sheet(triangles, inside, strips=2)
    np.testing.assert_allclose(points[opened.line, 0], 0.5)
    np.testing.assert_array_equal(opened.origin[opened.levels], opened.line[:, None] * np.ones(3))
    assert len(opened.origin) == len(points) + 2 * 5
    assert len(opened.band) == 2 * 4 * 2
    assert not np.isin(opened.outer, opened.levels[:, :-1]).any()
    assert not np.isin(opened.inner, opened.levels[:, 1:]).any()


def test_the_band_closes_the_gap():
    points, triangles = square()
    opened = open_sheet(triangles, points[:, 0] > 0.4, strips=2)
    plane = points[opened.origin]
    plane[opened.levels, 0] = 0.5 - 0.1 * np.arange(3)
    corner = plane[np.concatenate([opened.inner, opened.outer, opened.band])]
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    assert 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() == pytest.approx(1.0)


def test_a_shift_of_the_rim_shifts_all_and_what_is_outside_stays():
    radius, angle, triangles = disc(4, 12)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    with_one_more = np.vstack([points, [[5.0, 5.0]]])
    rim = np.flatnonzero(radius == 1.0)
    moved = spread(with_one_more, triangles, rim, points[rim] + [0.1, -0.2])
    np.testing.assert_allclose(moved[:-1], points + [0.1, -0.2])
    np.testing.assert_array_equal(moved[-1], [5.0, 5.0])
