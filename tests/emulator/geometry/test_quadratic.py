import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.discretisation import discretise, facet_rule
from emulator.geometry.generators.box import box
from emulator.geometry.mesh import EDGES, Mesh, orient, signed_volumes
from emulator.geometry.refinement import to_quadratic


@pytest.fixture(scope="module")
def mesh():
    return to_quadratic(box((2.0, 3.0, 4.0), (2, 1, 1)))


def test_midpoints_are_where_they_belong(mesh):
    corner = mesh.nodes[mesh.corners]
    middle = mesh.nodes[mesh.elements[:, 4:]]
    np.testing.assert_allclose(middle, corner[:, EDGES].mean(axis=2), atol=1e-14)
    assert len(mesh.nodes) == len(np.unique(np.round(mesh.nodes, 9), axis=0))


def test_sets_take_in_the_midpoints_of_the_surface(mesh):
    for name, axis, at in (("left", 0, 0.0), ("right", 0, 2.0), ("top", 2, 4.0)):
        on_face = np.flatnonzero(np.abs(mesh.nodes[:, axis] - at) < 1e-12)
        np.testing.assert_array_equal(np.sort(mesh.node_set(name)), on_face)
        facets = mesh.nodes[mesh.facet_set(name)]
        np.testing.assert_allclose(facets[:, 3], facets[:, [0, 1]].mean(axis=1))
        np.testing.assert_allclose(facets[:, 4], facets[:, [1, 2]].mean(axis=1))
        np.testing.assert_allclose(facets[:, 5], facets[:, [2, 0]].mean(axis=1))


def test_quadratic_fields_have_exact_gradients(mesh):
    grid = discretise(mesh)
    A = np.random.default_rng(0).normal(size=(3, 3))
    x = mesh.nodes
    field = np.einsum("ni,ij,nj->n", x, A, x)
    at = np.einsum("qa,mai->mqi", grid.values, x[grid.connectivity])
    slopes = np.einsum("ma,mqai->mqi", field[grid.connectivity], grid.gradients)
    np.testing.assert_allclose(slopes, at @ (A + A.T), atol=1e-11)
    assert grid.weights.sum() == pytest.approx(24.0, rel=1e-12)


def test_turning_an_element_round_keeps_its_edges(mesh):
    wrong = mesh.elements[:, [0, 1, 3, 2, 4, 8, 7, 6, 5, 9]]
    assert (signed_volumes(mesh.nodes, wrong) < 0).all()
    np.testing.assert_array_equal(orient(mesh.nodes, wrong), mesh.elements)


@pytest.mark.parametrize("order", [1, 2])
def test_facet_rules_integrate_shape_functions(order):
    rule = facet_rule(order, 2 * order)
    np.testing.assert_allclose(rule.values.sum(axis=1), 1.0, atol=1e-14)
    assert rule.weights.sum() == pytest.approx(0.5)
    # The corners of a quadratic facet carry nothing, its midpoints a third of the area each.
    expected = np.full(3, 1 / 6) if order == 1 else np.array([0, 0, 0, 1 / 6, 1 / 6, 1 / 6])
    np.testing.assert_allclose(rule.weights @ rule.values, expected, atol=1e-14)


def test_what_is_refused(mesh):
    with pytest.raises(InputError, match="quadratic already"):
        to_quadratic(mesh)
    with pytest.raises(InputError, match="needs linear tetrahedra"):
        mesh.to_skfem()
    folded = np.array(mesh.nodes)
    folded[mesh.elements[0, 4]] = folded[mesh.elements[0, 3]]
    with pytest.raises(InputError, match="folds over itself"):
        discretise(Mesh(folded, mesh.elements))
