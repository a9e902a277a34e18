import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from emulator.errors import InputError
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import LAWS, find_law
from emulator.mechanics.laws.neo_hookean import lame_from_engineering
from scene_support import rotation, slope

MU, LAM = 3.0, 7.0
ARGUMENTS = {"neo_hookean": (MU, LAM), "neo_hookean_E_nu": (8.0, 0.3)}


def energy(name, H):
    return find_law(name).energy(Strain(jnp.asarray(H)), *map(jnp.asarray, ARGUMENTS[name]))


def test_neo_hookean_equals_its_formula_in_F():
    F = np.eye(3) + 0.2 * np.random.default_rng(0).normal(size=(3, 3))
    J = np.linalg.det(F)
    expected = 0.5 * MU * (np.trace(F.T @ F) - 3.0) - MU * np.log(J) + 0.5 * LAM * np.log(J) ** 2
    assert energy("neo_hookean", F - np.eye(3)) == pytest.approx(expected, rel=1e-13)


def test_engineering_constants():
    # E = mu (3 lam + 2 mu) / (lam + mu), nu = lam / 2 (lam + mu)
    mu, lam = lame_from_engineering(jnp.array(8.0), jnp.array(0.3))
    assert mu * (3 * lam + 2 * mu) / (lam + mu) == pytest.approx(8.0)
    assert lam / (2 * (lam + mu)) == pytest.approx(0.3)


@pytest.mark.parametrize("name", sorted(LAWS))
def test_rest_is_free_of_energy_and_stress(name):
    rest = jnp.zeros((3, 3))
    assert energy(name, rest) == 0.0
    np.testing.assert_allclose(jax.grad(lambda H: energy(name, H))(rest), 0.0, atol=1e-14)


@pytest.mark.parametrize("name", sorted(LAWS))
def test_frame_indifference(name):
    F = np.eye(3) + 0.2 * np.random.default_rng(3).normal(size=(3, 3))
    turned = rotation() @ F
    assert energy(name, turned - np.eye(3)) == pytest.approx(
        float(energy(name, F - np.eye(3))), rel=1e-12
    )


@pytest.mark.parametrize("name", sorted(LAWS))
def test_stress_and_tangent_are_the_derivatives_taylor(name):
    rng = np.random.default_rng(5)
    H, D = 0.1 * rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    W = lambda h: energy(name, h)
    stress, tangent = jax.grad(W)(jnp.asarray(H)), jax.hessian(W)(jnp.asarray(H))
    steps = 0.1 / 2.0 ** np.arange(5)
    first = [abs(W(H + h * D) - W(H) - h * np.sum(stress * D)) for h in steps]
    second = [
        np.linalg.norm(
            jax.grad(W)(jnp.asarray(H + h * D)) - stress - h * np.einsum("ijkl,kl", tangent, D)
        )
        for h in steps
    ]
    assert slope(steps, np.array(first)) == pytest.approx(2.0, abs=0.1)
    assert slope(steps, np.array(second)) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("stretch", [0.7, 0.9, 1.2, 1.8])
def test_uniaxial_tension_against_the_scalar_solution(stretch):
    # P_22 = 0 gives mu (t^2 - 1) + lam ln(stretch t^2) = 0 for the lateral stretch t, and then
    # P_11 = mu (stretch - 1 / stretch) + lam ln(stretch t^2) / stretch.
    lateral = brentq(lambda t: MU * (t**2 - 1) + LAM * np.log(stretch * t**2), 0.2, 3.0, xtol=1e-14)
    expected = MU * (stretch - 1 / stretch) + LAM * np.log(stretch * lateral**2) / stretch
    H = jnp.diag(jnp.array([stretch, lateral, lateral]) - 1.0)
    stress = jax.grad(lambda h: energy("neo_hookean", h))(H)
    assert stress[0, 0] == pytest.approx(expected, rel=1e-11)
    np.testing.assert_allclose([stress[1, 1], stress[2, 2], stress[0, 1]], 0.0, atol=1e-11)


def test_an_inverted_point_has_no_energy():
    assert np.isnan(energy("neo_hookean", jnp.diag(jnp.array([-1.5, 0.0, 0.0]))))


def test_unknown_law_names_the_known_ones():
    with pytest.raises(InputError, match="law 'hooke' is unknown; known laws: neo_hookean"):
        find_law("hooke")
