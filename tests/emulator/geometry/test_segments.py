from dataclasses import replace

import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.generators.biventricle import biventricle
from emulator.geometry.generators.ellipsoid import HUMAN, human_ventricle
from emulator.geometry.heart_wall import aha_segments
from emulator.geometry.mesh import signed_volumes
from scene_support import rotation


def by_hand(centroid):
    """The published division of a truncated ellipsoid whose cavity goes from z = -58 to 20 mm."""
    x, y, z = centroid
    # Seen from the apex, anterior (y) on top, positive x lies left; anticlockwise from the top.
    degrees = np.degrees(np.arctan2(x, y)) % 360
    for first, low, high in ((1, -6.0, 20.0), (7, -32.0, -6.0)):
        if low <= z < high:
            borders = [30, 90, 150, 210, 270, 330]
            return first + sum(degrees >= border for border in borders) % 6
    return 13 + sum(degrees >= border for border in (45, 135, 225, 315)) % 4 if z >= -58 else 17


@pytest.mark.parametrize("size", [(5, 12, 1), (15, 30, 3)])
def test_labels_are_those_of_the_definition(size):
    mesh = human_ventricle(*size)
    labels = aha_segments(mesh)
    jitter = 1e-6 * np.vstack([np.eye(3), -np.eye(3)])
    around = mesh.nodes[mesh.elements].mean(axis=1)[:, None] + jitter
    expected = np.array([[by_hand(point) for point in points] for points in around])
    # A centroid on a border is in one of the segments that meet there, any other in its own.
    assert (labels[:, None] == expected).any(axis=1).all()
    assert np.mean(expected.min(axis=1) == expected.max(axis=1)) > 0.8


def test_volumes_are_the_ellipsoids():
    mesh = human_ventricle()
    labels, volumes = aha_segments(mesh), signed_volumes(mesh.nodes, mesh.elements)
    share = np.bincount(labels, volumes)[1:] / volumes.sum()

    def below(z):  # volume of the wall below z, as a share of all
        parts = [
            np.pi * s**2 * (max(z + t, 0.0) - (z**3 + t**3) * (z > -t) / (3 * t**2))
            for s, t in (
                (HUMAN.short_epicardium, HUMAN.long_epicardium),
                (HUMAN.short_endocardium, HUMAN.long_endocardium),
            )
        ]
        return (parts[0] - parts[1]) / HUMAN.volume

    np.testing.assert_allclose(share[:6], (1.0 - below(-6.0)) / 6, rtol=0.03)
    np.testing.assert_allclose(share[6:12], (below(-6.0) - below(-32.0)) / 6, rtol=0.03)
    np.testing.assert_allclose(share[12:16], (below(-32.0) - below(-58.0)) / 4, rtol=0.08)
    assert share[16] == pytest.approx(below(-58.0), rel=0.15)  # jagged: an element is a tenth of it


def test_the_septum_of_two_ventricles_is_septal():
    mesh = biventricle(rings=9, around=24, layers=(2, 1))
    labels = aha_segments(mesh, "lv_endocardium")
    centroids = mesh.nodes[mesh.elements].mean(axis=1)
    inside = (np.hypot(*centroids[:, :2].T) / HUMAN.short_epicardium) ** 2 + (
        centroids[:, 2] / HUMAN.long_epicardium
    ) ** 2 < 1.0
    right = np.isin(mesh.elements, mesh.facet_set("rv_endocardium")).any(axis=1)
    septal = np.isin(labels, (2, 3, 8, 9, 14))
    assert septal[inside & right].mean() > 0.75
    for left_side in ([5, 6], [11, 12], [16]):
        assert not np.isin(labels[inside & right], left_side).any()


def test_a_moved_body_has_the_same_segments():
    mesh, turn, shift = human_ventricle(5, 12, 1), rotation(3), np.array([30.0, -80.0, 12.0])
    moved = replace(mesh, nodes=mesh.nodes @ turn.T + shift)
    towards = {"axis": turn[:, 2] * 2.0, "anterior": turn[:, 1] + 0.5 * turn[:, 2]}
    labels = aha_segments(moved, through=shift + 7.0 * turn[:, 2], **towards)
    np.testing.assert_array_equal(labels, aha_segments(mesh))
    quadratic = human_ventricle(5, 12, 1, order=2)
    np.testing.assert_array_equal(aha_segments(quadratic), aha_segments(mesh))


def test_what_cannot_be_divided():
    mesh = human_ventricle(5, 12, 1)
    with pytest.raises(InputError, match=r"segments: no axis: \(0, 0, 0\)"):
        aha_segments(mesh, axis=(0, 0, 0))
    with pytest.raises(InputError, match="no direction across the axis, anterior"):
        aha_segments(mesh, anterior=(0, 0, 2))
    with pytest.raises(InputError, match="none of the .* elements is in segment .*; refine"):
        aha_segments(mesh, through=(200.0, 0.0, 0.0))
