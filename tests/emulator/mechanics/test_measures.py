import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import LAWS, find_law
from emulator.mechanics.laws.law import Law, modulus
from emulator.mechanics.measures import Measures, measures_read
from law_support import ARGUMENTS, directions

H = 0.2 * np.random.default_rng(3).normal(size=(3, 3)) + 0.1 * np.eye(3)


def test_what_laws_read():
    assert measures_read(find_law("neo_hookean")) == ("J_minus_1", "I1_minus_3")
    assert set(measures_read(find_law("guccione"))) == {"green_lagrange", "J_minus_1"}
    assert set(measures_read(find_law("holzapfel_ogden_orthotropic"))) == {
        "isochoric_I1_minus_3",
        "isochoric_I4f_minus_1",
        "isochoric_I4s_minus_1",
        "isochoric_I8fs",
        "J_minus_1",
    }


def test_a_law_of_the_gradient_reads_no_measures():
    def energy(strain, mu):
        return 0.5 * mu * jnp.sum(strain.H**2) + 0.0 * strain.J_minus_1

    assert measures_read(Law("of H", (modulus("mu"),), energy)) is None


@pytest.mark.parametrize(
    "names",
    [
        ("J_minus_1", "I1_minus_3"),
        (
            "isochoric_I4s_minus_1",
            "isochoric_I8fs",
            "J_minus_1",
            "isochoric_I1_minus_3",
            "isochoric_I4f_minus_1",
        ),
        ("green_lagrange", "isochoric_I2_minus_3", "J_minus_1"),
    ],
    ids=["plain", "isochoric", "tensor"],
)
def test_derivatives_are_those_of_the_measures(names):
    """In closed form, against two differentiations of the measures themselves."""
    rng, measures = np.random.default_rng(5), Measures(names)
    s = jnp.asarray(rng.normal(size=measures.size))
    for own in (jnp.eye(3)[:2], jnp.asarray(np.linalg.qr(rng.normal(size=(3, 3)))[0][:2])):
        for at in (jnp.asarray(H), jnp.zeros((3, 3))):
            of = lambda H, own=own: measures.of(H, own)
            slope, curvature = jax.jit(measures.derivatives)(at, own, s)
            np.testing.assert_allclose(slope, jax.jacfwd(of)(at), atol=1e-12)
            second = jnp.tensordot(s, jax.hessian(of)(at), 1)
            np.testing.assert_allclose(curvature, second, atol=1e-11)


FAST = ("neo_hookean", "holzapfel_ogden")  # without fibres and with


@pytest.mark.parametrize(
    "name",
    [
        name if name in FAST else pytest.param(name, marks=pytest.mark.slow)
        for name in LAWS
        if measures_read(LAWS[name])
    ],
)
def test_the_energy_of_measures_is_the_law(name):
    """As are its stress and tangent, by the chain rule written out."""
    law, arguments = find_law(name), tuple(map(jnp.asarray, ARGUMENTS[name]))
    own = directions(law)
    measures = Measures(measures_read(law))
    phi = measures.energy(lambda strain: law.energy(strain, *arguments), own)
    of = lambda H: measures.of(H, own)
    direct = lambda H: law.energy(Strain(H, None, own), *arguments)
    at = jnp.asarray(H)
    s, C = jax.grad(phi)(of(at)), jax.hessian(phi)(of(at))
    slope, second = jax.jacfwd(of)(at), jax.hessian(of)(at)
    np.testing.assert_allclose(phi(of(at)), direct(at), rtol=1e-12)
    np.testing.assert_allclose(jnp.tensordot(s, slope, 1), jax.grad(direct)(at), atol=1e-10)
    tangent = jnp.einsum("kij,kl,lab->ijab", slope, C, slope) + jnp.tensordot(s, second, 1)
    np.testing.assert_allclose(tangent, jax.hessian(direct)(at), atol=1e-8)


def test_blocks_part_the_entries():
    measures = Measures(("green_lagrange", "J_minus_1"))
    assert measures.size == 10
    np.testing.assert_array_equal(measures.blocks.sum(axis=0), 1.0)
    np.testing.assert_array_equal(measures.blocks.sum(axis=1), [9.0, 1.0])
