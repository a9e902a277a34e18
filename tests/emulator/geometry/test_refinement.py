"""Finer meshes of the same body, and fields carried to them."""

import numpy as np
import pytest

from emulator.geometry.discretisation import discretise, shapes_at
from emulator.geometry.generators.box import box
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.refinement import refined
from emulator.scenes.fibre_rules import Helix

MESHES = {
    "linear": lambda: box((3.0, 2.0, 1.0), (2, 1, 1)),
    "quadratic": lambda: box((3.0, 2.0, 1.0), (2, 1, 1), order=2),
    "curved": lambda: human_ventricle(3, 6, 1, order=2),
}


@pytest.fixture(params=MESHES)
def mesh(request):
    return MESHES[request.param]()


def test_old_nodes_stay_and_the_body_is_the_same(mesh):
    found = refined(mesh)
    n = len(mesh.nodes)
    np.testing.assert_array_equal(found.mesh.nodes[:n], mesh.nodes)
    assert found.mesh.order == 2
    assert len(found.mesh.elements) == found.children * len(mesh.elements)
    coarse, fine = discretise(mesh).weights.sum(), discretise(found.mesh).weights.sum()
    # The rule of four points is not exact for the Jacobian of a curved element.
    np.testing.assert_allclose(fine, coarse, rtol=2e-3)
    np.testing.assert_allclose(np.asarray(found.prolongation.sum(axis=1)).ravel(), 1.0)


def test_a_field_is_carried_as_it_is(mesh):
    """Its gradients at the finer points are those of its old element, whatever the field."""
    found = refined(mesh)
    u = np.random.default_rng(0).normal(size=mesh.nodes.shape)
    fine = discretise(found.mesh)
    carried = found.carry(u)[found.mesh.elements]
    H = np.einsum("mai,mqaj->mqij", carried, fine.gradients)
    points = np.einsum("qa,mai->mqi", fine.values, found.mesh.nodes[found.mesh.elements])
    values = np.einsum("qa,mai->mqi", fine.values, carried)
    from calibrate.measurements.location import gradients_at, locate

    some = points.reshape(-1, 3)[::37]
    elements, inside = locate(mesh, some)
    old = np.einsum("da,dai->di", shapes_at(mesh.order, inside)[0], u[mesh.elements[elements]])
    np.testing.assert_allclose(values.reshape(-1, 3)[::37], old, atol=1e-7)
    gradients = gradients_at(mesh, elements, inside)
    slope = np.einsum("dai,daj->dij", u[mesh.elements[elements]], gradients)
    np.testing.assert_allclose(H.reshape(-1, 3, 3)[::37], slope, atol=1e-5)


def test_sets_stay_on_their_surfaces():
    mesh = MESHES["quadratic"]()
    found = refined(mesh)
    for name, axis, at in (("left", 0, 0.0), ("top", 2, 1.0)):
        on = np.flatnonzero(found.mesh.nodes[:, axis] == at)
        np.testing.assert_array_equal(np.sort(found.mesh.node_set(name)), on)
        assert len(found.mesh.facet_set(name)) == 4 * len(mesh.facet_set(name))
    twice = refined(refined(MESHES["linear"]()).mesh).mesh
    assert len(twice.elements) == 8 * len(MESHES["linear"]().elements)


def test_directions_keep_their_length_and_side():
    mesh = MESHES["curved"]()
    found, fibres = refined(mesh), Helix((60.0, -60.0)).directions(mesh)[0]
    fine = found.directions(fibres)
    np.testing.assert_allclose(np.linalg.norm(fine, axis=-1), 1.0)
    parents = np.repeat(fibres[:, 0], found.children, axis=0)
    assert np.median(np.einsum("mqi,mi->mq", fine, parents)) > 0.5
    even = found.directions(np.tile([0.6, 0.8, 0.0], (len(mesh.elements), 1)))
    np.testing.assert_allclose(even, np.broadcast_to([0.6, 0.8, 0.0], even.shape), atol=1e-12)
