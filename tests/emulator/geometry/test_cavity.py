from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.geometry.facets import openings
from emulator.geometry.generators.ellipsoid import LAND, EllipsoidalWall, truncated_ellipsoid
from emulator.scenes import Support
from emulator.scenes.loads import CavityPressure
from emulator.scenes.scene import cavity_sets, find_cavity
from scene_support import block, slope

# A hemisphere of radius 10 mm: its base plane goes through the centre.
HEMISPHERE = EllipsoidalWall(10.0, 10.0, 13.0, 13.0, base=0.0)


def hollow(wall=HEMISPHERE, rings=4, around=12, order=1, **facet_sets):
    """A scene on a truncated ellipsoid; its facet sets can be replaced."""
    mesh = truncated_ellipsoid(wall, rings, around, 1, order)
    mesh = replace(mesh, facet_sets={**mesh.facet_sets, **facet_sets})
    return replace(block(), mesh=mesh, supports=(Support("base"),))


def test_hemisphere_at_the_rate_of_its_facets():
    exact = 2.0 / 3.0 * np.pi * 10.0**3 / 1000.0  # mL
    sizes = np.array([3, 6, 12])
    errors = {
        order: np.array(
            [exact - find_cavity(hollow(rings=n, around=3 * n, order=order)).rest for n in sizes]
        )
        for order in (1, 2)
    }
    assert 0.0 < errors[1][-1] < 0.02 * exact  # an inscribed polyhedron
    assert slope(1.0 / sizes, errors[1]) == pytest.approx(2.0, abs=0.1)
    assert abs(errors[2][-1]) < 1e-4 * exact
    assert slope(1.0 / sizes, np.abs(errors[2])) > 3.5


def test_truncated_ellipsoid():
    cavity = find_cavity(hollow(LAND, rings=10, around=36, order=2))
    assert cavity.rest == pytest.approx(LAND.cavity_volume / 1000.0, rel=1e-4)


def test_the_volume_goes_with_the_determinant_and_not_with_the_place():
    cavity = find_cavity(hollow())
    scene = hollow()
    X = scene.mesh.nodes[cavity.nodes]
    H = 0.2 * np.random.default_rng(0).normal(size=(3, 3))
    u = jnp.asarray(X @ H.T + [700.0, -20.0, 10.0])
    assert cavity(u) == pytest.approx(np.linalg.det(np.eye(3) + H) * cavity.rest, rel=1e-11)
    both = cavity(jnp.stack([u, jnp.zeros_like(u)])[None])
    np.testing.assert_allclose(both, [[float(cavity(u)), cavity.rest]], rtol=1e-14)


@pytest.mark.parametrize("order", [1, 2])
def test_positive_whatever_the_winding(order):
    plain = hollow(order=order)
    facets = plain.mesh.facet_set("endocardium")
    # Corners 0 and 1 swapped; on a quadratic facet the edges 12 and 20 swap with them.
    turned = facets[:, [1, 0, 2] if order == 1 else [1, 0, 2, 3, 5, 4]]
    mixed = np.where(np.arange(len(facets))[:, None] % 3 == 0, turned, facets)
    for other in (turned, mixed):
        assert find_cavity(hollow(order=order, endocardium=other)).rest == pytest.approx(
            find_cavity(plain).rest, rel=1e-13
        )
    assert find_cavity(plain).rest > 0.0


@pytest.mark.parametrize("order", [1, 2])
def test_the_derivative_is_that_of_a_central_difference(order):
    cavity = find_cavity(hollow(order=order))
    rng = np.random.default_rng(1)
    u, along = (jnp.asarray(rng.normal(size=(len(cavity.nodes), 3))) for _ in range(2))
    # A cubic in u: its central difference is off by h^2 times a constant only.
    h, volume = 1e-4, jax.jit(cavity)
    central = (volume(u + h * along) - volume(u - h * along)) / (2.0 * h)
    assert np.vdot(jax.jit(jax.grad(cavity))(u), along) == pytest.approx(float(central), rel=1e-7)


def test_each_opening_gets_a_lid_of_its_own():
    """A tube through a box, open at both ends: the box of its four walls."""
    scene = block(cells=(2, 2, 2))
    sets = scene.mesh.facet_sets
    walls = np.concatenate([sets[name] for name in sets if name not in ("left", "right")])
    assert len(openings(walls)) == 2
    tube = replace(scene, mesh=replace(scene.mesh, facet_sets={"tube": walls}))
    assert find_cavity(tube, "tube").rest == pytest.approx(2.0 * 3.0 * 4.0 / 1000.0, rel=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_loads_and_volumes_go_by_the_same_sign_whichever_way_facets_are_listed(order):
    """A cavity under pressure grows, and the load's work is the pressure times that growth."""
    plain = hollow(order=order)
    facets = plain.mesh.facet_set("endocardium")
    turned = facets[:, [1, 0, 2] if order == 1 else [1, 0, 2, 3, 5, 4]]
    u = 0.02 * jnp.asarray(plain.mesh.nodes) * ~plain.held
    for listed in (facets, turned):
        scene = hollow(order=order, endocardium=listed)
        cavity = find_cavity(scene)
        (term,) = CavityPressure("endocardium", 0.7).terms(scene.discretisation)
        growth = 1000.0 * (float(cavity(u[cavity.nodes])) - cavity.rest)
        assert growth > 0.0
        assert float(term.total(u, {})) == pytest.approx(-0.7 * growth, rel=1e-9)


def test_a_scene_names_its_cavities():
    scene = hollow()
    assert cavity_sets(scene) == ("endocardium",)
    pressed = replace(scene, loads=(CavityPressure("endocardium", 0.1),))
    assert find_cavity(pressed).facet_set == "endocardium"
    assert cavity_sets(em.scenes.once_clamped_beam(cells=(2, 1, 1), order=1)) == ()
    both = em.scenes.biventricle(rings=4, around=12, layers=(1, 1), order=1)
    assert cavity_sets(both) == ("lv_endocardium", "rv_endocardium")
    with pytest.raises(InputError, match="has 2 cavities; name a facet set: lv_endocardium, rv_"):
        find_cavity(both)
    with pytest.raises(InputError, match="facet set 'right' encloses no volume"):
        find_cavity(block(), "right")
