"""A ventricle seen from itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emulator.core.errors import InputError
from emulator.geometry.generators.ellipsoid import HUMAN, truncated_ellipsoid
from emulator.geometry.heart_wall import Ventricle, ventricle
from emulator.geometry.mesh import Mesh, signed_volumes
from emulator.scenes.built_in.ventricles import left_ventricle


def body(mesh: Mesh) -> Ventricle:
    held = np.zeros(len(mesh.nodes), dtype=bool)
    held[mesh.node_sets["base"]] = True
    return ventricle(mesh, "endocardium", held)


def test_an_ellipsoid_is_what_it_was_made_as() -> None:
    mesh = truncated_ellipsoid(HUMAN, 20, 40, 3)
    found = body(mesh)
    assert np.allclose(found.axis, [0.0, 0.0, 1.0], atol=1e-12)
    assert found.cavity + found.wall == pytest.approx(1.0)
    # The polyhedron is inside the ellipsoid.
    expected = (HUMAN.cavity_volume + HUMAN.volume) ** (1.0 / 3.0)
    assert 0.98 * expected < found.size < expected
    depth = -(HUMAN.long_endocardium + HUMAN.base)
    assert found.size * found.height[found.inner].min() == pytest.approx(depth, rel=1e-9)
    assert np.abs(found.lean).max() < 1e-9
    assert found.depth[found.inner].max() == 0.0
    assert found.depth.max() == 1.0
    assert signed_volumes(mesh.nodes, mesh.elements).sum() == pytest.approx(
        found.wall * found.size**3
    )


def test_vectors_turn_with_the_body_and_numbers_do_not() -> None:
    mesh = truncated_ellipsoid(HUMAN, 6, 12, 2, thicker=(0.2, 40.0))
    R, scale = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix(), 1.3
    moved = Mesh(scale * mesh.nodes @ R.T + [5.0, 6.0, 7.0], mesh.elements, mesh.node_sets,
                 mesh.facet_sets)  # fmt: skip
    first, second = body(mesh), body(moved)
    assert np.allclose(first.vectors() @ R.T, second.vectors(), atol=1e-12)
    for name in ("cavity", "wall", "depth", "height", "inner", "held"):
        assert np.allclose(getattr(first, name), getattr(second, name), atol=1e-12)
    assert second.size == pytest.approx(scale * first.size)


def test_it_leans_towards_the_thick_side() -> None:
    lean = body(truncated_ellipsoid(HUMAN, 8, 16, 2, thicker=(0.25, 90.0))).lean
    assert lean[1] > 0.5
    assert abs(lean[0]) < 0.05 * lean[1]


@pytest.mark.parametrize("towards", [0.0, 90.0])
def test_a_wall_thicker_on_one_side(towards: float) -> None:
    """At the base the wall is as much thicker there as it is thinner opposite; not at the apex."""
    even, mesh = (
        truncated_ellipsoid(HUMAN, 8, 16, 1, thicker=t) for t in ((0.0, 0.0), (0.2, towards))
    )
    half = len(mesh.nodes) // 2
    inside, outside = mesh.nodes[:half], mesh.nodes[half:]
    assert np.array_equal(inside, even.nodes[:half])
    thickness = np.linalg.norm(outside - inside, axis=1)
    before = np.linalg.norm(even.nodes[half:] - inside, axis=1)
    assert thickness[0] == pytest.approx(before[0])
    base = np.flatnonzero(inside[:, 2] > HUMAN.base - 1e-6)
    way = inside[base] @ [np.cos(np.radians(towards)), np.sin(np.radians(towards)), 0.0]
    ratio = thickness[base] / before[base]
    assert ratio[np.argmax(way)] == pytest.approx(1.2, abs=0.01)
    assert ratio[np.argmin(way)] == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize("thicker", [(-0.1, 0.0), (0.6, 0.0), (0.1, np.nan)])
def test_walls_that_cannot_be_meshed(thicker: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="thicker by"):
        truncated_ellipsoid(HUMAN, 4, 8, 1, thicker=thicker)


def test_the_shape_is_part_of_the_scene() -> None:
    scene = left_ventricle(4, 8, 1, thicker=(0.2, 40.0), order=1)
    assert scene.origin["thicker"] == [0.2, 40.0]
    assert "thicker" not in left_ventricle(4, 8, 1, order=1).origin


def test_bodies_that_are_no_ventricle() -> None:
    mesh = truncated_ellipsoid(HUMAN, 4, 8, 1)
    nothing = np.zeros(len(mesh.nodes), dtype=bool)
    with pytest.raises(InputError, match="no base"):
        ventricle(mesh, "endocardium", nothing)
    with pytest.raises(InputError, match="quadratic"):
        ventricle(truncated_ellipsoid(HUMAN, 3, 6, 1, order=2), "endocardium", nothing)
