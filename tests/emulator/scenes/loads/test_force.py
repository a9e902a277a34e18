"""Forces on points and edges, by hand."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.energy import dead_force
from emulator.geometry.refinement import to_quadratic
from emulator.scenes import Parameter
from emulator.scenes.loads import Force, Traction
from emulator.scenes.loads.force import shares
from scene_support import block


def with_edge(mesh):
    """The edge x = 2, z = 4 mm of the block of 2 by 3 by 4 mm, and its middle's node."""
    edge = np.intersect1d(mesh.node_set("right"), mesh.node_set("top"))
    corner = edge[np.argmin(mesh.nodes[edge, 1])]
    return replace(mesh, node_sets={**mesh.node_sets, "edge": edge, "corner": np.array([corner])})


@pytest.fixture(params=[1, 2], ids=["P1", "P2"])
def scene(request):
    plain = block(cells=(2, 3, 2))
    mesh = plain.mesh if request.param == 1 else to_quadratic(plain.mesh)
    return replace(plain, mesh=with_edge(mesh))


def test_an_edge_carries_its_force_evenly(scene):
    force = dead_force(replace(scene, loads=(Force("edge", (0.1, 0.0, -0.3)),))).constant
    np.testing.assert_allclose(force.sum(axis=0), [100.0, 0.0, -300.0], rtol=1e-12)
    arm = scene.mesh.nodes - [2.0, 1.5, 4.0]
    np.testing.assert_allclose(np.cross(arm, force).sum(axis=0), 0.0, atol=1e-10)
    # The work on u = y^2 is the mean of y^2 along 3 mm, 3 mm2, which Simpson's rule gives.
    work = float(np.vdot(force[:, 2], scene.mesh.nodes[:, 1] ** 2))
    exact = -300.0 * 3.0
    assert work == pytest.approx(exact, rel=1e-12 if scene.mesh.order == 2 else 0.06)


def test_a_point_carries_all_of_it(scene):
    (corner,) = scene.mesh.node_set("corner")
    force = dead_force(replace(scene, loads=(Force("corner", (0.0, 0.2, 0.0)),))).constant
    np.testing.assert_array_equal(force[corner], [0.0, 200.0, 0.0])
    assert np.abs(force).sum() == 200.0


def test_each_node_may_have_its_own(scene):
    own = np.array([[0.0, 0.1, 0.0], [0.3, 0.0, 0.0]])
    nodes = scene.mesh.node_set("edge")[:2]
    mesh = replace(scene.mesh, node_sets={**scene.mesh.node_sets, "two": nodes})
    pulled = replace(scene, mesh=mesh, loads=(Force("two", own),))
    force = dead_force(pulled).constant
    np.testing.assert_array_equal(force[nodes], 1e3 * own)
    assert np.abs(force).sum() == 400.0
    other = replace(scene, mesh=mesh, loads=(Force("two", own[::-1]),))
    assert other.fingerprint != pulled.fingerprint
    with pytest.raises(InputError, match="has 3 rows for 2 nodes"):
        replace(scene, mesh=mesh, loads=(Force("two", np.zeros((3, 3))),))


def test_nodes_apart_share_alike(scene):
    apart = np.array([0, len(scene.mesh.nodes) // 2])
    found = shares(scene.mesh, apart)
    np.testing.assert_array_equal(found[apart], 0.5)


def test_an_amount_multiplies_it():
    plain = block()
    scene = replace(plain, mesh=with_edge(plain.mesh))
    loaded = replace(
        scene,
        loads=(Force("edge", (0.0, 0.0, -0.01), amount="percent"),),
        parameters=(*scene.parameters, Parameter("percent", "", 0.9, 1.1)),
    )
    known = replace(scene, loads=(Force("edge", (0.0, 0.0, -0.0105)),))
    theta = jnp.array([3.0, 4.0, 1.05])
    u = em.Simulator(loaded)(theta)
    np.testing.assert_allclose(u, em.Simulator(known)(theta[:2]), atol=1e-10)
    assert loaded.load_parameters == ("percent",)


def test_far_away_it_is_the_traction_of_its_resultant():
    """Saint-Venant: stiff beam, force on the end's edge or shear stress on the end's face."""
    beam = block(cells=(2, 2, 2))
    mesh = to_quadratic(beam.mesh)
    mesh = with_edge(replace(mesh, nodes=mesh.nodes * [10.0, 1.0, 1.0]))
    beam = replace(beam, mesh=mesh)
    theta = jnp.array([100.0, 100.0])
    # Weight in the middle of the edge and of the face: 12 mm2.
    by_edge = em.Simulator(replace(beam, loads=(Force("edge", (0.0, 0.0, -1e-3)),)))(theta)
    face = (Traction("right", (0.0, 0.0, -1.0 / 12.0)),)
    by_face = em.Simulator(replace(beam, loads=face))(theta)
    middle = np.argmin(np.linalg.norm(mesh.nodes - [20.0, 1.5, 2.0], axis=1))
    assert by_edge[middle, 2] == pytest.approx(float(by_face[middle, 2]), rel=0.02)


def test_a_force_that_cannot_be():
    with pytest.raises(InputError, match="force on 'tip' is .* give 3 finite numbers in N"):
        Force("tip", (0.0, np.nan, 1.0))
    with pytest.raises(InputError, match="node set 'tip'"):
        replace(block(), loads=(Force("tip", (0.0, 0.0, 1.0)),))
