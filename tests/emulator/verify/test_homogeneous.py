import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import LAWS
from emulator.specimens.homogeneous import homogeneous
from emulator.verify.homogeneous import SOLUTIONS, pulled, verify_homogeneous


def by_formula(name, pulls, values=None):
    """Stretches (2 k, 3) along x, then along x and y, at which the formula's free stresses vanish."""
    formula, own = SOLUTIONS[name]
    found = []
    for held in (1, 2):
        for pull in pulls:

            def state(free, held=held, pull=pull):
                return np.append(np.full(held, pull), free)

            start = np.full(3 - held, pull ** (-held / (3.0 - held)))
            solved = root(
                lambda free, held=held: formula(state(free), values or own)[held:], start, tol=1e-14
            )
            found.append(state(solved.x))
    return np.array(found)


def by_map(scene):
    """The stretches (m, 3) of a specimen's states by the forward map."""
    theta = jnp.array([SOLUTIONS[scene.law.name][1][scene.parameter_names[0]]])
    u = np.asarray(jax.jit(homogeneous(scene).evaluate)(theta).displacement)
    return 1.0 + np.stack([u[k::3, k] for k in range(3)], axis=1)


def test_every_law_has_a_solution():
    assert set(SOLUTIONS) == set(LAWS)
    for name, law in LAWS.items():
        assert tuple(SOLUTIONS[name][1]) == law.parameters


@pytest.mark.parametrize("name", sorted(LAWS))
def test_the_laws_agree_with_the_written_out_stress(name):
    pulls = np.array([0.8, 0.95, 1.0, 1.1, 1.3])
    law, arguments = LAWS[name], [jnp.asarray(v) for v in SOLUTIONS[name][1].values()]
    directions = jnp.eye(3)[:2] if law.sheets else jnp.eye(3)[0]
    stretches = by_formula(name, pulls)

    def energy(H):
        return law.energy(Strain(H, None, directions), *arguments)

    P = jax.vmap(jax.grad(energy))(jax.vmap(jnp.diag)(jnp.asarray(stretches) - 1.0))
    formula, values = SOLUTIONS[name]
    expected = np.stack([formula(each, values) for each in stretches])
    np.testing.assert_allclose(P, np.einsum("mi,ij->mij", expected, np.eye(3)), atol=1e-11)
    np.testing.assert_allclose(expected[:, 2], 0.0, atol=1e-9)


@pytest.mark.parametrize(
    "name",
    [
        n if n in ("neo_hookean", "holzapfel_ogden") else pytest.param(n, marks=pytest.mark.slow)
        for n in sorted(LAWS)
    ],
)
def test_specimens_without_a_mesh_agree(name):
    pulls = [0.85, 1.0, 1.2]
    np.testing.assert_allclose(by_map(pulled(name, pulls)), by_formula(name, pulls), atol=1e-11)


def test_the_incompressible_limit_of_neo_hooke():
    # P = mu (s - s^-2) along one axis, mu (s - s^-5) along two.
    s = np.array([0.7, 1.5])
    values = {"mu": 10.0, "lam": 1e6}
    stretches = by_formula("neo_hookean", s, values)
    stress = [SOLUTIONS["neo_hookean"][0](each, values)[0] for each in stretches]
    expected = np.concatenate([10.0 * (s - s**-2), 10.0 * (s - s**-5)])
    np.testing.assert_allclose(stress, expected, rtol=1e-4)


def test_small_strain_is_linear_elasticity():
    E, nu, strain = 30.0, 0.4, 1e-7
    values = {"E": E, "nu": nu}
    stretches = by_formula("neo_hookean_E_nu", [1.0 + strain], values)
    one, two = (SOLUTIONS["neo_hookean_E_nu"][0](each, values) for each in stretches)
    assert one[0] / strain == pytest.approx(E, rel=1e-5)
    assert (stretches[0, 1] - 1.0) / strain == pytest.approx(-nu, rel=1e-5)
    assert two[0] / strain == pytest.approx(E / (1.0 - nu), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(LAWS))
def test_fem_cubes_agree(name):
    rows = verify_homogeneous([name])
    assert len(rows) == 8
    assert [row for row in rows if not row.passed] == []
