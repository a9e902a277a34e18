"""Where landmarks lie: linear meshes against barycentric coordinates, quadratic against fields."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.measurements import spread_landmarks
from calibrate.measurements.location import locate
from emulator.core.errors import InputError
from emulator.geometry.discretisation import shapes_at
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.refinement import to_quadratic
from scene_support import block

NO_THETA = jnp.zeros(0)


def by_hand(mesh, point):
    """Barycentric coordinates in every element, of the element that holds the point."""
    corner = mesh.nodes[mesh.elements]
    sides = np.transpose(corner[:, 1:] - corner[:, :1], (0, 2, 1))
    xi = np.linalg.solve(sides, (point - corner[:, 0])[..., None])[..., 0]
    lam = np.concatenate([1.0 - xi.sum(axis=1, keepdims=True), xi], axis=1)
    best = int(np.argmax(lam.min(axis=1)))
    return best, lam[best]


def test_linear_meshes_against_barycentric_coordinates(ventricle):
    points = spread_landmarks(ventricle, 40, seed=1)
    elements, weights = locate(ventricle.mesh, points)
    for point, element, found in zip(points, elements, weights, strict=True):
        expected, coordinates = by_hand(ventricle.mesh, point)
        assert element == expected
        np.testing.assert_allclose(found, coordinates, atol=1e-12)


@pytest.fixture(scope="module")
def curved():
    """A ventricle of quadratic elements with curved walls."""
    scene = em.scenes.left_ventricle_neo_hookean(rings=4, around=8, layers=1, order=1)
    return replace(scene, mesh=human_ventricle(4, 8, 1, order=2))


def test_a_quadratic_field_is_met_exactly_where_edges_are_straight():
    mesh = to_quadratic(block().mesh)
    points = np.random.default_rng(0).uniform([0, 0, 0], [2, 3, 4], (30, 3))
    elements, inside = locate(mesh, points)
    weights, _ = shapes_at(2, inside)
    assert weights.shape == (30, 10)

    def field(x):
        return 1.0 + x[:, 0] * x[:, 1] - 2.0 * x[:, 2] ** 2 + x[:, 1]

    values = np.einsum("da,da->d", weights, field(mesh.nodes)[mesh.elements[elements]])
    np.testing.assert_allclose(values, field(points), atol=1e-11)


def test_curved_elements_meet_positions_and_linear_fields(curved):
    assert curved.mesh.order == 2
    points = spread_landmarks(curved, 30, seed=0)
    observe = cal.landmarks(curved, points)
    assert observe.weights.shape == (30, 10)
    H = np.random.default_rng(0).normal(size=(3, 3))
    u = curved.mesh.nodes @ H.T + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(
        observe(jnp.asarray(u[observe.nodes]), NO_THETA), points @ H.T + [1, 2, 3], atol=1e-9
    )


def test_points_just_outside_a_curved_wall_are_moved_onto_it(curved):
    facets = curved.mesh.facet_set("epicardium")
    corner, middle = curved.mesh.nodes[facets[:, 0]], curved.mesh.nodes[facets[:, 3:]]
    outward = np.cross(middle[:, 0] - corner, middle[:, 2] - corner)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    on_edges = middle[:, 0]
    observe = cal.landmarks(curved, on_edges + 2e-4 * curved.mesh.size * outward)
    x = jnp.asarray(curved.mesh.nodes[observe.nodes])
    gap = np.linalg.norm(observe(x, NO_THETA) - on_edges, axis=1)
    assert gap.max() < 3e-4 * curved.mesh.size
    with pytest.raises(InputError, match="landmark 0 at .* lies outside the body, about"):
        cal.landmarks(curved, on_edges[:1] + 5e-3 * curved.mesh.size * outward[:1])


def test_points_on_faces_edges_and_corners(ventricle, curved):
    """Where coordinates are zero the search converges linearly; all are met to 1e-9 mm."""
    for mesh in (ventricle.mesh, curved.mesh):
        nodes = mesh.nodes[mesh.elements[::7]]
        corners = np.eye(4)[[0, 1]]
        mixed = np.array([[0.5, 0.5, 0, 0], [0, 0.2, 0.3, 0.5], [0.7, 0, 0.3, 0]])
        for L in np.concatenate([corners, mixed]):
            points = np.einsum("a,dai->di", shapes_at(mesh.order, L[None])[0][0], nodes)
            elements, inside = locate(mesh, points)
            shapes, _ = shapes_at(mesh.order, inside)
            back = np.einsum("da,dai->di", shapes, mesh.nodes[mesh.elements[elements]])
            np.testing.assert_allclose(back, points, atol=1e-9)


def test_points_in_another_unit_are_refused(beam):
    """Those in metres lie inside, all at the clamp; their displacements are next to nothing."""
    points = spread_landmarks(beam, 12, 3)
    locate(beam.mesh, points[:4] * 0.5)
    with pytest.raises(InputError, match="pixels instead of mm. multiply by the size of a pixel"):
        locate(beam.mesh, 40.0 * points)
    for factor, unit, repair in ((1e-3, "m", "1000"), (1e3, "µm", "0.001")):
        with pytest.raises(InputError, match=f"12 points span .* {unit} instead of mm.* {repair}$"):
            locate(beam.mesh, factor * points)
