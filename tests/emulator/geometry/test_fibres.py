from dataclasses import replace

import numpy as np
import pytest

from emulator.errors import InputError
from emulator.geometry.bodies.biventricle import biventricle
from emulator.geometry.bodies.box import box
from emulator.geometry.bodies.ellipsoid import HUMAN, human_ventricle, land_ventricle
from emulator.geometry.bodies.sphere import sphere_octant
from emulator.geometry.fibres import (
    Depth,
    biventricular_directions,
    depth,
    rule_based_directions,
    rule_based_fibres,
    turned,
)
from geometry_support import order_of


def centroids(mesh):
    return mesh.nodes[mesh.elements[:, :4]].mean(axis=1)


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


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip(np.einsum("mi,mi->m", a, b), -1.0, 1.0)))


def test_depth_in_a_sphere_is_harmonic():
    # tau = (1/a - 1/r) / (1/a - 1/b) with a = 1, b = 2
    errors = []
    for n in (2, 4):
        mesh = sphere_octant(1.0, 2.0, (3 * n, 2 * n))
        found = depth(mesh, ("inner",), ("outer",))
        radii = np.linalg.norm(centroids(mesh), axis=1)
        errors.append(np.sqrt(np.mean((found.value - (2.0 - 2.0 / radii)) ** 2)))
        away = degrees_between(found.normal, centroids(mesh) / radii[:, None])
    assert order_of(np.array(errors))[0] > 1.7
    assert away.max() < 4.0


@pytest.mark.parametrize(("angle", "which", "most"), [(0.0, 1, 7.0), (90.0, 2, 7.0)])
def test_directions_on_an_ellipsoid_are_those_of_its_parametrisation(angle, which, most):
    mesh = human_ventricle()
    wanted = analytic(HUMAN, centroids(mesh))[which]
    away = degrees_between(rule_based_fibres(mesh, angles=(angle, angle)), wanted)
    assert np.median(away) < 1.0
    assert away.max() < most


def test_fibres_on_an_ellipsoid_turn_as_the_analytic_ones():
    mesh = human_ventricle()
    t, circumferential, climbing = analytic(HUMAN, centroids(mesh))
    alpha = np.radians(60.0 - 120.0 * t)[:, None]
    away = degrees_between(
        rule_based_fibres(mesh, angles=(60.0, -60.0)),
        np.cos(alpha) * circumferential + np.sin(alpha) * climbing,
    )
    # A harmonic depth runs ahead of the even one in a curved wall, here by 0.05 of 120 degrees.
    assert np.median(away) < 7.0


def test_the_helix_angle_is_linear_in_depth():
    normal = np.tile([1.0, 0.0, 0.0], (3, 1))
    found = turned(Depth(np.array([0.0, 0.5, 1.0]), normal), (-90.0, 90.0), (0.0, 0.0, 2.0))
    np.testing.assert_allclose(found.fibres, [[0, 0, -1], [0, 1, 0], [0, 0, 1]], atol=1e-15)


def test_directions_are_orthonormal_and_a_wall_across_the_axis_has_some():
    slab = box((2.0, 2.0, 1.0), (2, 2, 2))
    for mesh, inside, outside in (
        (land_ventricle(), "endocardium", "epicardium"),
        (slab, "bottom", "top"),
    ):
        fibres, sheets = rule_based_directions(mesh, inside, outside)
        np.testing.assert_allclose(np.linalg.norm(fibres, axis=1), 1.0)
        np.testing.assert_allclose(np.linalg.norm(sheets, axis=1), 1.0)
        np.testing.assert_allclose(np.einsum("mi,mi->m", fibres, sheets), 0.0, atol=1e-12)


def test_each_ventricle_has_its_own_depth():
    mesh = biventricle(rings=12, around=24, layers=(3, 2))
    fibres, sheets = biventricular_directions(mesh, angles=(60.0, -60.0))
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
    fibres, sheets = biventricular_directions(biventricle(rings=8, around=16, layers=(1, 1)))
    np.testing.assert_allclose(np.linalg.norm(fibres, axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.norm(sheets, axis=1), 1.0)


def test_a_quadratic_mesh_has_the_fibres_of_its_linear_one():
    np.testing.assert_allclose(
        rule_based_fibres(land_ventricle(order=2)), rule_based_fibres(land_ventricle()), atol=1e-10
    )


def test_bad_input_is_named():
    mesh = land_ventricle(rings=3, around=6, layers=1)
    with pytest.raises(InputError, match=r"axis \(0, 0, 0\); expected three numbers, not all zero"):
        rule_based_fibres(mesh, axis=(0, 0, 0))
    with pytest.raises(InputError, match=r"angles \(60,\); expected two numbers in degrees"):
        rule_based_fibres(mesh, angles=(60,))
    with pytest.raises(InputError, match="facet set 'inside' is not in the mesh"):
        rule_based_fibres(mesh, endocardium="inside")
    facets = mesh.facet_set("endocardium")
    closed = replace(mesh, facet_sets={"endocardium": facets, "epicardium": facets})
    with pytest.raises(InputError, match="'endocardium' and 'epicardium' have nodes in common"):
        rule_based_fibres(closed)
