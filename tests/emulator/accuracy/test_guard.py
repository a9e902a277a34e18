import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.accuracy.estimate import guard, invariants
from scene_support import block


@pytest.fixture(scope="module")
def body():
    return block()


def affine(scene, *stretches):
    """Displacement of a body stretched along the axes."""
    return jnp.asarray(scene.mesh.nodes * (np.array(stretches) - 1.0))


def test_the_parameter_its_value_and_its_range(body):
    against = guard(body, jnp.array([12.0, 5.0]), affine(body, 1.0, 1.0, 1.0))
    assert not against.trusted
    assert against.sentence(body) == "parameter 'mu' is 12 kPa, outside 1 to 10"
    inside = guard(body, jnp.array([10.0, 1.0]), affine(body, 1.0, 1.0, 1.0))
    assert inside.trusted
    assert inside.sentence(body) == ""


def test_zero_and_negative_on_a_log_scale_are_outside(body):
    for value in (0.0, -3.0, jnp.nan):
        against = guard(body, jnp.array([2.0, value]), affine(body, 1.0, 1.0, 1.0))
        np.testing.assert_array_equal(against.outside, [False, True])


def test_inverted(body):
    against = guard(body, body.centre, affine(body, -0.5, 1.0, 1.0))
    assert against.sentence(body) == "an element is inverted (least J = -0.5)"


@pytest.mark.parametrize(
    ("stretches", "active"),
    [
        ((0.04, 1.0, 1.0), True),  # J = 0.04, below 0.05
        ((0.2, 1.0, 1.0), False),  # its isochoric I1 is 6.0
        ((3.1, 0.6, 0.6), True),  # I1 = 10.3, above 10
        ((2.8, 0.8, 0.8), False),  # I1 = 9.1; J = 1.79, and 9.1 J^(-2/3) = 6.2
    ],
)
def test_barriers(body, stretches, active):
    against = guard(body, body.centre, affine(body, *stretches))
    assert bool(against.barrier) is active
    assert ("barriers" in against.sentence(body)) is active


def test_invariants_with_fibres():
    scene = em.scenes.left_ventricle(rings=2, around=6, layers=1, order=1)
    stretches = np.array([1.5, 0.9, 0.7])
    J, I1, I4f = invariants(scene, affine(scene, *stretches), scene.centre)
    volume = stretches.prod()
    np.testing.assert_allclose(J, volume)
    np.testing.assert_allclose(I1, (stretches**2).sum() * max(1.0, volume ** (-2 / 3)))
    along = ((scene.fibres * stretches) ** 2).sum(axis=1)
    np.testing.assert_allclose(I4f[:, 0], along * max(1.0, volume ** (-2 / 3)))


def test_not_finite(body):
    against = guard(body, body.centre, affine(body, jnp.nan, 1.0, 1.0))
    assert not against.trusted
    assert against.sentence(body) == "the prediction is not finite"


def test_inside_vmap(body):
    thetas = jnp.array([[2.0, 2.0], [2.0, 20.0]])
    fields = jnp.stack([affine(body, 1.0, 1.0, 1.0)] * 2)
    trusted = jax.jit(jax.vmap(lambda t, u: guard(body, t, u).trusted))(thetas, fields)
    np.testing.assert_array_equal(trusted, [True, False])
