"""Directions at quadrature points: from one an element, from nodes, from files."""

import meshio
import numpy as np
import pytest

from emulator.geometry.discretisation import (
    from_quadrature_points,
    quadrature_points,
    shapes_at,
)
from emulator.geometry.fibres import (
    across,
    biventricular_depth,
    from_elements,
    from_nodes,
    of_elements,
    turned,
    unit,
)
from emulator.geometry.generators.biventricle import biventricle
from emulator.geometry.generators.box import box
from emulator.geometry.io import read_body, write_mesh
from emulator.geometry.refinement import to_quadratic
from geometry_support import order_of

MESH = box((1.0, 1.0, 1.0), (4, 4, 4))


def centroids(mesh):
    return mesh.nodes[mesh.corners].mean(axis=1)


def points(mesh):
    """Where the quadrature points (m, 4, 3) of the mesh made quadratic lie."""
    return np.einsum("qa,mai->mqi", quadrature_points(2), mesh.nodes[mesh.corners])


def turning(x, rate=2.0):
    """A field (..., 3) that turns about z and climbs along x."""
    angle, climb = rate * x[..., 2], 0.5 * x[..., 0]
    return np.stack(
        [np.cos(angle) * np.cos(climb), np.sin(angle) * np.cos(climb), np.sin(climb)], axis=-1
    )


def off(found, wanted):
    """Root mean square of the angle in degrees, whatever the signs."""
    cosine = np.abs(np.sum(found * wanted, axis=-1))
    return float(np.degrees(np.sqrt(np.mean(np.arccos(np.minimum(cosine, 1.0)) ** 2))))


def signs(rng, count):
    return rng.choice([-1.0, 1.0], (count, 1))


def test_a_field_that_is_linear_up_to_its_length_is_nearly_itself():
    """Up to what lengths differ between neighbours: 0.03 degrees, where constant ones are 0.9 off."""
    slope = np.random.default_rng(0).normal(size=(3, 3))
    linear = lambda x: unit(np.array([3.0, 1.0, 2.0]) + x @ slope.T)
    found, given = from_elements(MESH, linear(centroids(MESH))), linear(centroids(MESH))
    assert found.shape == (len(MESH.elements), 4, 3)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, rtol=1e-14)
    wanted = linear(points(MESH))
    assert off(found, wanted) < 0.05 * off(given[:, None], wanted)
    # Mid-edge nodes that are there already, on straight edges, change nothing.
    np.testing.assert_array_equal(from_elements(to_quadratic(MESH), given), found)


def test_a_constant_field_is_itself():
    given = np.tile([0.6, 0.0, 0.8], (len(MESH.elements), 1))
    np.testing.assert_allclose(
        from_elements(MESH, given), np.repeat(given[:, None], 4, 1), rtol=1e-14
    )
    np.testing.assert_allclose(of_elements(from_elements(MESH, given)), given, rtol=1e-14)


def test_elements_may_have_any_sign():
    """An element given the other way round is found the other way round, at all of its points."""
    given = turning(centroids(MESH))
    flip = signs(np.random.default_rng(1), len(given))
    np.testing.assert_allclose(
        from_elements(MESH, flip * given), flip[:, None] * from_elements(MESH, given), atol=1e-12
    )


def test_a_jump_is_not_smeared():
    """Directions 90 degrees apart, as where two walls meet."""
    left = centroids(MESH)[:, :1] < 0.5
    given = np.where(left, np.eye(3)[0], np.eye(3)[2])
    np.testing.assert_allclose(from_elements(MESH, given), np.repeat(given[:, None], 4, axis=1))


def test_a_turning_field_converges_by_second_order():
    errors = []
    for n in (2, 4, 8):
        mesh = box((1.0, 1.0, 1.0), (n, n, n))
        errors.append(off(from_elements(mesh, turning(centroids(mesh))), turning(points(mesh))))
    assert order_of(np.array(errors)).min() > 2.0
    # Constant in an element it is 3 degrees off, on the finest mesh.
    assert errors[-1] < 0.1 < 2.0 < off(turning(centroids(mesh))[:, None], turning(points(mesh)))


@pytest.mark.parametrize(("order", "least"), [(1, 1.8), (2, 2.6)])
def test_nodes_are_interpolated_by_the_elements_own_shape_functions(order, least):
    errors = []
    for n in (2, 4):
        mesh = box((1.0, 1.0, 1.0), (n, n, n), order)
        errors.append(off(from_nodes(mesh, turning(mesh.nodes), 2), turning(points(mesh))))
    assert order_of(np.array(errors))[0] > least


def test_nodes_may_have_any_sign():
    at_nodes = turning(MESH.nodes)
    flip = signs(np.random.default_rng(2), len(at_nodes))
    found, flipped = (from_nodes(MESH, values, 2) for values in (at_nodes, flip * at_nodes))
    np.testing.assert_allclose(flipped, flip[MESH.elements[:, :1]] * found, atol=1e-14)


@pytest.mark.parametrize("order", [1, 2])
def test_a_field_linear_in_an_element_is_known_from_its_points(order):
    """And, with one point, a constant one."""
    barycentric = np.random.default_rng(3).dirichlet(np.ones(4), 7)
    corners = np.array([2.0, -1.0, 0.5, 3.0]) if order == 2 else np.full(4, 2.0)
    at_points = quadrature_points(order) @ corners
    weights = from_quadrature_points(order, barycentric)
    np.testing.assert_allclose(weights @ at_points, barycentric @ corners)
    values, slopes = shapes_at(order, barycentric)
    np.testing.assert_allclose(values.sum(axis=1), 1.0)
    np.testing.assert_allclose(slopes.sum(axis=1), 0.0, atol=1e-12)


def laid(x):
    """A turning fibre and a sheet that turns about it."""
    f = turning(x)
    first = unit(np.cross([0.0, 0.0, 1.0], f))
    angle = x[..., 1:2]
    return f, np.cos(angle) * first + np.sin(angle) * np.cross(f, first)


@pytest.mark.parametrize("where", ["cells", "points"])
def test_a_file_made_quadratic_has_sheets_across_its_fibres(tmp_path, where):
    path = tmp_path / "body.vtu"
    if where == "cells":
        write_mesh(path, MESH, *laid(centroids(MESH)))
    else:
        at_nodes = dict(zip(("fibres", "sheets"), laid(MESH.nodes), strict=True))
        cells = [("tetra", MESH.elements)]
        meshio.write(path, meshio.Mesh(MESH.nodes, cells, point_data=at_nodes))
    plain, body = read_body(path), read_body(path, quadratic=True)
    assert plain.fibres.shape == plain.sheets.shape == (len(MESH.elements), 3)
    assert body.mesh.order == 2
    for found, wanted in zip((body.fibres, body.sheets), laid(points(MESH)), strict=True):
        assert found.shape == (len(MESH.elements), 4, 3)
        assert off(found, wanted) < 1.0
    np.testing.assert_allclose(np.sum(body.fibres * body.sheets, axis=-1), 0.0, atol=1e-12)


def test_sheets_stay_across_fibres_where_two_walls_meet(tmp_path):
    """A few elements there have neighbours of the other wall, up to 60 degrees off."""
    mesh = biventricle(rings=8, around=16, layers=(1, 1))
    directions = turned(biventricular_depth(mesh), (90.0, -90.0), (0.0, 0.0, 1.0))
    write_mesh(tmp_path / "heart.vtu", mesh, *directions)
    body = read_body(tmp_path / "heart.vtu", quadratic=True)
    np.testing.assert_allclose(np.sum(body.fibres * body.sheets, axis=-1), 0.0, atol=1e-12)


def test_sheets_that_were_not_across_their_fibres_stay_so(tmp_path):
    """A scene refuses them, as it would on linear elements."""
    fibres = turning(centroids(MESH))
    write_mesh(tmp_path / "body.vtu", MESH, fibres, unit(fibres + laid(centroids(MESH))[1]))
    body = read_body(tmp_path / "body.vtu", quadratic=True)
    assert np.abs(np.sum(body.fibres * body.sheets, axis=-1)).min() > 0.5


@pytest.mark.parametrize("order", [1, 2])
def test_directions_of_points_are_written_and_read(tmp_path, order):
    """Those of a quadratic mesh as 12 components."""
    mesh = box((1.0, 2.0, 3.0), (1, 2, 2), order)
    rng = np.random.default_rng(4)
    shape = (len(mesh.elements), len(quadrature_points(order)), 3)
    fibres = unit(rng.normal(size=shape))
    sheets = across(unit(rng.normal(size=shape)), fibres)
    write_mesh(tmp_path / "body.vtu", mesh, fibres, sheets)
    body = read_body(tmp_path / "body.vtu")
    for found, given in ((body.fibres, fibres), (body.sheets, sheets)):
        wanted = given[:, 0] if order == 1 else given
        np.testing.assert_allclose(found, wanted, atol=1e-14)
