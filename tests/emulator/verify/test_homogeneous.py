import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import LAWS
from emulator.verify.homogeneous import SOLUTIONS, equibiaxial, uniaxial, verify_homogeneous


def test_every_law_has_a_solution():
    assert set(SOLUTIONS) == set(LAWS)
    for name, law in LAWS.items():
        assert tuple(SOLUTIONS[name][1]) == law.parameters


@pytest.mark.parametrize("solve", [uniaxial, equibiaxial])
@pytest.mark.parametrize("stretch", [0.8, 0.95, 1.0, 1.1, 1.3])
@pytest.mark.parametrize("name", sorted(LAWS))
def test_the_laws_agree_with_the_written_out_stress(name, stretch, solve):
    state = solve(name, stretch, SOLUTIONS[name][1])
    assert state.stretches[0] == stretch
    along_y = stretch if solve is equibiaxial else state.stretches[2]
    if not LAWS[name].sheets:
        assert state.stretches[1] == along_y
    law, values = LAWS[name], map(jnp.asarray, SOLUTIONS[name][1].values())
    arguments = tuple(values)
    directions = jnp.eye(3)[:2] if law.sheets else jnp.eye(3)[0]

    def energy(H):
        return law.energy(Strain(H, None, directions), *arguments)

    P = jax.grad(energy)(jnp.diag(jnp.array(state.stretches) - 1.0))
    np.testing.assert_allclose(P, np.diag(state.stresses), atol=1e-11)
    np.testing.assert_allclose(state.stresses[2], 0.0, atol=1e-11)


def test_the_incompressible_limit_of_neo_hooke():
    # P = mu (s - s^-2) along one axis, mu (s - s^-5) along two.
    stiff = {"mu": 10.0, "lam": 1e8}
    for s in (0.7, 1.5):
        assert uniaxial("neo_hookean", s, stiff).stresses[0] == pytest.approx(
            10.0 * (s - s**-2), rel=1e-5
        )
        assert equibiaxial("neo_hookean", s, stiff).stresses[0] == pytest.approx(
            10.0 * (s - s**-5), rel=1e-5
        )


def test_small_strain_is_linear_elasticity():
    E, nu, strain = 30.0, 0.4, 1e-7
    values = {"E": E, "nu": nu}
    one = uniaxial("neo_hookean_E_nu", 1.0 + strain, values)
    assert one.stresses[0] / strain == pytest.approx(E, rel=1e-5)
    assert (one.stretches[1] - 1.0) / strain == pytest.approx(-nu, rel=1e-5)
    two = equibiaxial("neo_hookean_E_nu", 1.0 + strain, values)
    assert two.stresses[0] / strain == pytest.approx(E / (1.0 - nu), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(LAWS))
def test_fem_cubes_agree(name):
    rows = verify_homogeneous([name])
    assert len(rows) == 8
    assert [row for row in rows if not row.passed] == []
