from dataclasses import replace

import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.discretisation import discretise
from emulator.geometry.fibres import (
    Depth,
    biventricular_depth,
    nodal_depth,
    of_elements,
    turned,
    wall_depth,
)
from emulator.geometry.generators.biventricle import biventricle
from emulator.geometry.generators.box import box
from emulator.geometry.generators.ellipsoid import HUMAN, human_ventricle, land_ventricle
from emulator.geometry.generators.sphere import sphere_octant
from geometry_support import order_of


def centroids(mesh):
    return mesh.nodes[mesh.elements[:, :4]].mean(axis=1)


def quadrature_points_of(mesh):
    """Where they lie, (m, q, 3)."""
    return np.einsum("qa,mai->mqi", discretise(mesh).values, mesh.nodes[mesh.elements])


def analytic(wall, points):
    """Depth, circumferential and longitudinal directions from the ellipsoid's parametrisation."""
    around = np.hypot(points[:, 0], points[:, 1])
    low, high = np.zeros(len(points)), np.ones(len(points))
    for _ in range(50):  # the depth at which the ellipsoid goes through the point
        t = 0.5 * (low + high)
        short = wall.short_endocardium + t * (wall.short_epicardium - wall.short_endocardium)
        long = wall.long_endocardium + t * (wall.long_epicardium - wall.long_endocardium)
        deeper = (around / short) ** 2 + (points[:, 2] / long) ** 2 > 1.0
        low, high = np.where(deeper, t, low), np.where(deeper, high, t)
    u, phi = (
        np.arctan2(around / short, -points[:, 2] / long),
        np.arctan2(points[:, 1], points[:, 0]),
    )
    climbing = np.stack(
        [short * np.cos(u) * np.cos(phi), short * np.cos(u) * np.sin(phi), long * np.sin(u)], axis=1
    )
    circumferential = np.stack([-np.sin(phi), np.cos(phi), 0.0 * phi], axis=1)
    return t, circumferential, climbing / np.linalg.norm(climbing, axis=1, keepdims=True)


def ruled(
    mesh, angles=(90.0, -90.0), axis=(0.0, 0.0, 1.0), inside="endocardium", outside="epicardium"
):
    """Fibres and sheets by rule."""
    return turned(wall_depth(mesh, (inside,), (outside,)), angles, axis)


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=-1), -1.0, 1.0)))


def test_depth_in_a_sphere_is_harmonic():
    # tau = (1/a - 1/r) / (1/a - 1/b) with a = 1, b = 2
    errors = []
    for n in (2, 4):
        mesh = sphere_octant(1.0, 2.0, (3 * n, 2 * n))
        found = wall_depth(mesh, ("inner",), ("outer",))
        radii = np.linalg.norm(centroids(mesh), axis=1)
        errors.append(np.sqrt(np.mean((found.value - (2.0 - 2.0 / radii)) ** 2)))
        away = degrees_between(found.normal, centroids(mesh) / radii[:, None])
    assert order_of(np.array(errors))[0] > 1.7
    assert away.max() < 4.0


def test_a_quadratic_depth_is_an_order_better():
    """At the points; coarse, as the sphere's wall of 4 layers above: 7e-4 and 0.6 degrees."""
    errors, away = [], []
    for n in (1, 2):
        mesh = sphere_octant(1.0, 2.0, (3 * n, 2 * n), order=2)
        found, points = wall_depth(mesh, ("inner",), ("outer",)), quadrature_points_of(mesh)
        assert found.value.shape == points.shape[:2]
        assert found.normal.shape == points.shape
        radii = np.linalg.norm(points, axis=-1)
        errors.append(np.sqrt(np.mean((found.value - (2.0 - 2.0 / radii)) ** 2)))
        away.append(degrees_between(found.normal, points / radii[..., None]).max())
    assert order_of(np.array(errors))[0] > 2.5
    assert order_of(np.array(away))[0] > 1.5
    assert away[-1] < 1.0


@pytest.mark.parametrize(("angle", "which", "most"), [(0.0, 1, 7.0), (90.0, 2, 7.0)])
def test_directions_on_an_ellipsoid_are_those_of_its_parametrisation(angle, which, most):
    mesh = human_ventricle()
    wanted = analytic(HUMAN, centroids(mesh))[which]
    away = degrees_between(ruled(mesh, (angle, angle))[0], wanted)
    assert np.median(away) < 1.0
    assert away.max() < most


def test_fibres_on_an_ellipsoid_turn_as_the_analytic_ones():
    mesh = human_ventricle()
    t, circumferential, climbing = analytic(HUMAN, centroids(mesh))
    alpha = np.radians(60.0 - 120.0 * t)[:, None]
    away = degrees_between(
        ruled(mesh, (60.0, -60.0))[0],
        np.cos(alpha) * circumferential + np.sin(alpha) * climbing,
    )
    # A harmonic depth runs ahead of the even one in a curved wall, here by 0.05 of 120 degrees.
    assert np.median(away) < 7.0


def test_the_helix_angle_is_linear_in_depth():
    normal = np.tile([1.0, 0.0, 0.0], (3, 1))
    fibres, _ = turned(Depth(np.array([0.0, 0.5, 1.0]), normal), (-90.0, 90.0), (0.0, 0.0, 2.0))
    np.testing.assert_allclose(fibres, [[0, 0, -1], [0, 1, 0], [0, 0, 1]], atol=1e-15)


def test_directions_are_orthonormal_and_a_wall_across_the_axis_has_some():
    slab = box((2.0, 2.0, 1.0), (2, 2, 2))
    for mesh, inside, outside in (
        (land_ventricle(), "endocardium", "epicardium"),
        (land_ventricle(4, 12, 1, order=2), "endocardium", "epicardium"),
        (slab, "bottom", "top"),
    ):
        fibres, sheets = ruled(mesh, inside=inside, outside=outside)
        count = len(mesh.elements)
        assert fibres.shape == ((count, 3) if mesh.order == 1 else (count, 4, 3))
        np.testing.assert_allclose(np.linalg.norm(fibres, axis=-1), 1.0)
        np.testing.assert_allclose(np.linalg.norm(sheets, axis=-1), 1.0)
        np.testing.assert_allclose(np.sum(fibres * sheets, axis=-1), 0.0, atol=1e-12)


def test_each_ventricle_has_its_own_depth():
    mesh = biventricle(rings=12, around=24, layers=(3, 2))
    fibres, sheets = turned(biventricular_depth(mesh), (60.0, -60.0), (0.0, 0.0, 1.0))
    np.testing.assert_allclose(np.linalg.norm(fibres, axis=1), 1.0)
    np.testing.assert_allclose(np.einsum("mi,mi->m", fibres, sheets), 0.0, atol=1e-12)
    for name, climbs in (("lv_endocardium", 1), ("rv_endocardium", -1), ("epicardium", -1)):
        behind = mesh.elements_behind(mesh.facet_set(name))
        x, _, z = centroids(mesh)[behind].T
        half_way = (np.abs(z) < 20.0) & (x < 34.0)  # nothing of the free wall but its edges
        slope = np.median(fibres[behind, 2][half_way])
        assert climbs * slope > 0.3, name
    inside = mesh.elements_behind(mesh.facet_set("rv_endocardium"))
    x, _, z = centroids(mesh)[inside].T
    assert np.median(fibres[inside, 2][(x > 45.0) & (np.abs(z) < 20.0)]) > 0.3


def test_a_wall_of_one_layer_has_directions():
    # All nodes of the free wall are on surfaces, where the left ventricle's fields are constant.
    depth = biventricular_depth(biventricle(rings=8, around=16, layers=(1, 1)))
    fibres, sheets = turned(depth, (90.0, -90.0), (0.0, 0.0, 1.0))
    np.testing.assert_allclose(np.linalg.norm(fibres, axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.norm(sheets, axis=1), 1.0)


def test_quadratic_elements_have_more_accurate_fibres_where_they_are_used():
    """At their points, on eight elements around and one layer: 0.4 degrees off, linear ones 2.5."""
    median, largest = [], []
    for order in (1, 2):
        mesh = human_ventricle(4, 8, 1, order)
        found = ruled(mesh, (0.0, 0.0))[0].reshape(-1, 3)
        _, circumferential, _ = analytic(HUMAN, quadrature_points_of(mesh).reshape(-1, 3))
        away = degrees_between(found, circumferential)
        median.append(np.median(away))
        largest.append(away.max())
    assert median[1] < 0.6 < 2.0 < median[0]
    assert largest[1] < 4.0 < 8.0 < largest[0]


def test_quadratic_and_linear_elements_have_the_same_fibres_in_the_limit():
    """Mean directions of their elements differ by 6, 1.8 degrees: second order."""
    gaps = []
    for n in (1, 2):
        linear, quadratic = (
            ruled(human_ventricle(4 * n, 8 * n, n, order), (60.0, -60.0))[0] for order in (1, 2)
        )
        gaps.append(np.median(degrees_between(linear, of_elements(quadratic))))
    assert order_of(np.array(gaps))[0] > 1.5
    assert gaps[-1] < 2.5


def test_nodal_depth_is_of_linear_meshes():
    mesh = sphere_octant(1.0, 2.0, (6, 4))
    inner, outer = (np.unique(mesh.facet_set(name)) for name in ("inner", "outer"))
    value, normal = nodal_depth(mesh, inner, outer)
    radii = np.linalg.norm(mesh.nodes, axis=1)
    np.testing.assert_allclose(value, 2.0 - 2.0 / radii, atol=0.03)
    assert degrees_between(normal, mesh.nodes / radii[:, None]).max() < 9.0
    with pytest.raises(InputError, match="the depth at its nodes"):
        nodal_depth(sphere_octant(1.0, 2.0, (3, 2), order=2), inner, outer)


def test_bad_input_is_named():
    mesh = land_ventricle(rings=3, around=6, layers=1)
    with pytest.raises(InputError, match=r"axis \(0, 0, 0\); expected three numbers, not all zero"):
        ruled(mesh, axis=(0, 0, 0))
    with pytest.raises(InputError, match=r"angles \(60,\); expected two numbers in degrees"):
        ruled(mesh, (60,))
    with pytest.raises(InputError, match="facet set 'inside' is not in the mesh"):
        ruled(mesh, inside="inside")
    facets = mesh.facet_set("endocardium")
    closed = replace(mesh, facet_sets={"endocardium": facets, "epicardium": facets})
    with pytest.raises(InputError, match="'endocardium' and 'epicardium' have nodes in common"):
        ruled(closed)
