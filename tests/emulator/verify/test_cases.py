"""The cases of calibrate verify: the quick ones as they are, the others on coarse meshes."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import emulator as em
from calibrate.cli.commands.verify import CASE_NAMES
from emulator.verify import CASES, Benchmark
from emulator.verify.consistency import verify_barriers, verify_invariance, verify_patch
from emulator.verify.cook import deflection, membrane
from emulator.verify.land import beam
from emulator.verify.sphere import INNER, OUTER, inner_stretch, order_of, pressure_at, sphere_scene
from emulator.verify.sphere import MU as SHEAR


def test_the_command_line_knows_every_case():
    assert tuple(CASES) == CASE_NAMES


@pytest.mark.parametrize(
    "case",
    [
        *(pytest.param(case, marks=pytest.mark.slow) for case in (verify_patch, verify_invariance)),
        verify_barriers,
    ],
)
def test_what_holds_exactly(case):
    rows = case()
    assert [row for row in rows if not row.passed] == []


def test_a_row_outside_its_tolerance_has_not_passed():
    assert not Benchmark("x", 1.2, 1.0, 0.1, "").passed
    assert not Benchmark("x", float("nan"), 1.0, 0.1, "").passed
    assert Benchmark("x", 0.95, 1.0, 0.1, "").passed


@pytest.mark.parametrize("stretch", [1.1, 1.5])
def test_the_spheres_pressure_is_the_integral_of_radial_equilibrium(stretch):
    # d sigma_r / dr = 2 mu (l^2 - l^-4) / r with l = r / R and r^3 - R^3 constant.
    a = stretch * INNER
    b = (OUTER**3 + a**3 - INNER**3) ** (1 / 3)

    def slope(r):
        l = r / (r**3 - a**3 + INNER**3) ** (1 / 3)  # noqa: E741
        return 2 * SHEAR * (l**2 - l**-4) / r

    assert pressure_at(stretch) == pytest.approx(quad(slope, a, b)[0], rel=1e-10)


def test_the_order_of_three_meshes():
    assert order_of(*(1.0 + 0.3 * h**2.5 for h in (1.0, 0.5, 0.25))) == pytest.approx(2.5)


@pytest.mark.slow
def test_a_coarse_sphere():
    assert inner_stretch(em.Simulator(sphere_scene((3, 2))), 1.2) == pytest.approx(1.2, rel=5e-3)


@pytest.mark.slow
def test_a_coarse_membrane_does_not_lock():
    fine = deflection(em.Simulator(membrane(4, "mean")), 0.4999)
    assert fine == pytest.approx(12.0, rel=0.03)
    assert deflection(em.Simulator(membrane(8, "P1")), 0.4999) < 0.6 * fine


@pytest.mark.slow
def test_lands_beam_on_a_coarse_mesh():
    scene = beam((8, 1, 4))
    solution = em.Simulator(scene).solve(jnp.array([2.0]))
    assert solution.converged
    tip = np.argmin(np.linalg.norm(scene.mesh.nodes - [10.0, 0.5, 1.0], axis=1))
    assert 1.0 + solution.displacement[tip, 2] == pytest.approx(4.2, abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASE_NAMES)
def test_every_case_in_full(name):
    assert [row for row in CASES[name]() if not row.passed] == []
