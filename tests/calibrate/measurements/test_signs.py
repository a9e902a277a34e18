"""What is positive in data: a body that is pulled, blown up or lengthened, for every kind."""

import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em

STRETCH = 0.05
BAR = em.Scene(
    "bar",
    em.generators.box((4.0, 1.0, 1.0), (4, 1, 1)),
    em.find_law("neo_hookean"),
    (em.Parameter("mu", "kPa", 1.0, 10.0), em.Parameter("lam", "kPa", 1.0, 10.0)),
    supports=(em.Support("left"), em.Support("right", np.array([4.0 * STRETCH, 0.0, 0.0]))),
)
VENTRICLE = em.scenes.left_ventricle(3, 6, 1, order=1)


def seen(scene, observe, grown):
    """What is observed of nodes X that move to ``grown(X)``."""
    u = jnp.asarray(grown(scene.mesh.nodes) - scene.mesh.nodes)
    return np.asarray(observe.evaluate(u[observe.nodes], jnp.asarray(scene.centre)))


def pulled(X):
    return X * [1.0 + STRETCH, 1.0, 1.0]


def blown_up(X):
    return X * [1.0 + STRETCH, 1.0 + STRETCH, 1.0]


@pytest.mark.parametrize(
    ("observe", "expected"),
    [
        (cal.nodal_displacements(BAR, "right"), [[0.2, 0.0, 0.0]] * 4),
        (cal.landmarks(BAR, np.array([[2.0, 0.5, 0.5]])), [[0.1, 0.0, 0.0]]),
        (cal.surface_points(BAR, "right", np.array([[4.0, 0.5, 0.5]])), [0.2]),
        # Out of the tissue is against x on the left.
        (cal.surface_points(BAR, "left", np.array([[0.0, 0.5, 0.5]])), [0.0]),
    ],
    ids=["nodes", "landmark", "surface ahead", "surface at rest"],
)
def test_what_moves_along_x_is_positive(observe, expected):
    np.testing.assert_allclose(seen(BAR, observe, pulled), expected, atol=1e-12)


def test_what_moves_into_the_tissue_is_negative():
    left = cal.surface_points(BAR, "left", np.array([[0.0, 0.5, 0.5]]))
    np.testing.assert_allclose(seen(BAR, left, lambda X: X + [0.1, 0.0, 0.0]), [-0.1])


@pytest.mark.parametrize(("support", "sign"), [("right", 1.0), ("left", -1.0)])
def test_a_reaction_is_the_supports_force_on_the_body(support, sign):
    """The machine pulls a bar that is longer than at rest, outwards at both ends."""
    force = seen(BAR, cal.Reaction(BAR, support, "x"), pulled)
    assert sign * force > 0.0
    squeezed = seen(BAR, cal.Reaction(BAR, support, "x"), lambda X: X * [0.95, 1.0, 1.0])
    assert sign * squeezed < 0.0


def test_a_cavity_that_is_blown_up_is_larger():
    at_rest = seen(VENTRICLE, cal.CavityVolume(VENTRICLE), lambda X: X)
    larger = seen(VENTRICLE, cal.CavityVolume(VENTRICLE), blown_up)
    assert larger == pytest.approx(at_rest * (1.0 + STRETCH) ** 2)
    assert at_rest > 0.0


def test_a_wall_that_is_longer_around_has_positive_strain():
    at = cal.spread_landmarks(VENTRICLE, 3, 0)
    strain = seen(VENTRICLE, cal.strains(VENTRICLE, ("circumferential",), at), blown_up)
    np.testing.assert_allclose(strain, 0.5 * ((1.0 + STRETCH) ** 2 - 1.0), rtol=1e-6)


def test_an_endocardium_that_is_blown_up_moves_into_its_wall():
    """Its normal points out of the tissue, into the cavity."""
    nodes = np.unique(VENTRICLE.mesh.facet_set("endocardium"))[10:14]
    inner = cal.surface_points(VENTRICLE, "endocardium", VENTRICLE.mesh.nodes[nodes])
    assert (seen(VENTRICLE, inner, blown_up) < 0.0).all()
    nodes = np.unique(VENTRICLE.mesh.facet_set("epicardium"))[10:14]
    outer = cal.surface_points(VENTRICLE, "epicardium", VENTRICLE.mesh.nodes[nodes])
    assert (seen(VENTRICLE, outer, blown_up) > 0.0).all()
