"""The cases of calibrate verify: the quick ones as they are, the others on coarse meshes."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import axisymmetric_support
import emulator as em
from emulator.verify import CASES, Benchmark
from emulator.verify.benchmark import order_of
from emulator.verify.consistency import (
    block,
    taylor_of_energy,
    verify_barriers,
    verify_invariance,
    verify_patch,
)
from emulator.verify.incompressible import (
    INNER,
    OUTER,
    deflection,
    inner_stretch,
    membrane,
    pressure_at,
    sphere_scene,
)
from emulator.verify.incompressible import MU as SHEAR
from emulator.verify.land import apexes, beam, contraction, fibres


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


@pytest.mark.slow
def test_the_tangent_is_the_derivative_of_the_residual():
    """Both triangles of it: its upper triangle alone would leave a remainder of order one."""
    rows = taylor_of_energy("P1", em.Simulator(block("P1")))
    assert [row.measured for row in rows] == pytest.approx([2.0, 2.0], abs=0.05)


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
@pytest.mark.parametrize("name", CASES)
def test_every_case_in_full(name):
    assert [row for row in CASES[name]() if not row.passed] == []


def test_fibres_of_the_benchmark():
    """Unit vectors in the ellipsoids, along the meridian on both surfaces, a circle between."""
    scene = contraction(3, 8, 1)
    mesh = scene.mesh
    along = fibres(mesh)
    np.testing.assert_allclose(np.linalg.norm(along, axis=-1), 1.0, rtol=1e-12)
    X = np.einsum("qa,mai->mqi", scene.discretisation.values, mesh.nodes[mesh.elements])
    radius, z = np.hypot(X[..., 0], X[..., 1]), X[..., 2]
    # (r / (7 + 3t))^2 + (z / (17 + 3t))^2 = 1 and the slope of an ellipsoid, written again.
    circle = np.stack([-X[..., 1], X[..., 0], 0.0 * z], axis=-1) / radius[..., None]
    alpha = np.arccos(np.clip(np.einsum("mqi,mqi->mq", along, circle), -1.0, 1.0))
    meridian = along - np.cos(alpha)[..., None] * circle
    sign = np.sign(-meridian[..., 2])  # the meridian is taken towards the apex
    t = 0.5 - sign * alpha / np.pi
    short, long = 7.0 + 3.0 * t, 17.0 + 3.0 * t
    np.testing.assert_allclose((radius / short) ** 2 + (z / long) ** 2, 1.0, atol=1e-9)
    normal = np.stack([X[..., 0] / short**2, X[..., 1] / short**2, z / long**2], axis=-1)
    np.testing.assert_allclose(np.einsum("mqi,mqi->mq", along, normal), 0.0, atol=1e-9)


@pytest.mark.slow
def test_the_contracting_ventricle_by_other_elements():
    """Numbers of the table by axisymmetric elements; a coarse mesh of tetrahedra is near them."""
    inside, outside = axisymmetric_support.apexes(3, 24)
    assert inside == pytest.approx(-12.33, abs=0.08)
    assert outside == pytest.approx(-15.47, abs=0.02)
    inside, outside = apexes(contraction(5, 10, 2), C=2.0)
    assert inside == pytest.approx(-12.33, abs=0.5)
    assert outside == pytest.approx(-15.47, abs=0.08)
