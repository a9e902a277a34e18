"""PETSc's factorisations against SuiteSparse's; most are skipped where petsc4py is missing."""

import sys
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.linear import Outcome
from emulator.fem.linear.pattern import Pattern
from emulator.fem.linear.petsc import PETSC, Factor, petsc_module
from emulator.fem.linear.reuse import KeptFactor
from emulator.fem.linear.solve import attempt
from emulator.fem.linear.solve import solve as solve_any
from emulator.scenes.loads import FollowerPressure
from emulator.verify.consistency import block as nearly_incompressible
from scene_support import block


@pytest.fixture(scope="module")
def petsc():
    """The module petsc4py.PETSc."""
    pytest.importorskip("petsc4py", reason="petsc4py, the optional extra 'petsc', is not installed")
    return petsc_module()


def matrix(size=40, *, shift=4.0, symmetric=True):
    """A sparse matrix, its pattern and its values; indefinite without the shift."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(size, size)) * (rng.random((size, size)) < 0.2)
    A = 0.5 * (A + A.T) + shift * np.eye(size) if symmetric else A + shift * np.eye(size)
    rows, columns = np.nonzero(np.triu(A) if symmetric else A)
    none = np.zeros(0, np.int32)
    pattern = Pattern(
        rows.astype(np.int32), columns.astype(np.int32), none, none, size, upper=symmetric
    )
    return A, pattern, jnp.asarray(A[rows, columns]), jnp.asarray(rng.normal(size=size))


def test_an_unknown_factorisation_is_refused():
    with pytest.raises(InputError, match="'pardiso' is unknown; known: suitesparse, petsc"):
        em.Simulator(block(), factorisation="pardiso")
    with pytest.raises(InputError, match="factorisation 'lu' is unknown"):
        System(block(), "lu").direct  # noqa: B018


def test_without_petsc_one_line_says_what_to_install(monkeypatch):
    petsc_module.cache_clear()
    for module in ("petsc4py", "petsc4py.PETSc"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match="petsc4py is not installed; pip install") as refusal:
        em.Simulator(block(), factorisation="petsc")
    assert "\n" not in str(refusal.value)
    petsc_module.cache_clear()


@pytest.mark.usefixtures("petsc")
def test_inertia_tells_a_definite_matrix_from_an_indefinite_one():
    A, pattern, values, b = matrix(shift=0.0)
    assert np.linalg.eigvalsh(A)[0] < 0.0
    factor = Factor(pattern)
    factor.factorise(np.asarray(values))
    assert factor.negative_eigenvalues() == (np.linalg.eigvalsh(A) < 0.0).sum()
    refused = partial(attempt, PETSC, pattern)
    assert refused(values, b)[1] == Outcome.INDEFINITE
    # The factor of the refused matrix serves the one that takes any.
    np.testing.assert_allclose(
        solve_any(PETSC, pattern, values, b), np.linalg.solve(A, b), rtol=1e-8
    )
    assert PETSC.factor.factorisations == 1
    assert jax.jit(refused)(values, b)[1] == Outcome.INDEFINITE
    A, pattern, values, b = matrix(shift=8.0)
    assert np.linalg.eigvalsh(A)[0] > 0.0
    x, outcome = attempt(PETSC, pattern, values, b)
    assert outcome == Outcome.OK
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-9)


@pytest.mark.usefixtures("petsc")
def test_a_singular_matrix_is_named():
    _, pattern, values, b = matrix()
    x, outcome = PETSC.solve(pattern, 0.0 * values, b, "general")
    assert outcome == Outcome.SINGULAR
    assert np.isnan(x).all()
    # The next matrix is not harmed.
    np.testing.assert_allclose(
        pattern.product(values, solve_any(PETSC, pattern, values, b)), b, atol=1e-9
    )


def test_options_that_leave_no_factor_are_refused(petsc):
    _, pattern, _, _ = matrix()
    petsc.Options()["pc_type"] = "jacobi"
    try:
        with pytest.raises(InputError, match="leave it at cholesky of mumps"):
            Factor(pattern)
    finally:
        petsc.Options().delValue("pc_type")


@pytest.mark.usefixtures("petsc")
def test_a_matrix_is_factorised_once():
    _, pattern, values, b = matrix()
    factor = Factor(pattern)
    for _ in range(2):
        factor.factorise(np.asarray(values))
        factor.solve(np.asarray(b))
    factor.factorise(2.0 * np.asarray(values))
    assert factor.factorisations == 2
    assert factor.serves(replace(pattern))


@pytest.mark.slow
def test_iterations_make_an_approximate_factor_exact(petsc):
    """Block low-rank factors, asked for as PETSC_OPTIONS would ask."""
    scene = em.scenes.once_clamped_beam(cells=(16, 5, 5), order=1)
    system = System(scene, "petsc")
    K, _ = system.safe_tangent(jnp.zeros(scene.held.shape), scene.centre, 0.0)
    b = np.random.default_rng(0).normal(size=system.pattern.size)
    exact = System(scene).solve(K, jnp.asarray(b))
    options = petsc.Options()
    approximate = {"mat_mumps_icntl_35": 2, "mat_mumps_cntl_7": 1e-3}
    given = approximate | {"ksp_type": "fgmres", "ksp_rtol": 1e-12}
    for name, value in given.items():
        options[name] = value
    try:
        factor = Factor(system.pattern)
        factor.factorise(np.asarray(K))
        found = factor.solve(b)
    finally:
        for name in given:
            options.delValue(name)
    np.testing.assert_allclose(found, exact, atol=1e-9 * float(abs(exact).max()))


@pytest.mark.usefixtures("petsc")
def test_a_solution_is_checked_by_its_residual():
    """Here the factor is another matrix's."""
    _, pattern, values, b = matrix()
    factor = Factor(pattern)
    factor.factorise(np.asarray(values))
    factor._ksp.getPC().setReusePreconditioner(True)
    factor._matrix.scale(1.001)
    with pytest.raises(InputError, match="leaves a residual of .*: add -ksp_type fgmres"):
        factor.solve(np.asarray(b))
    with pytest.raises(InputError, match="leaves a residual of nan"):
        factor.solve(np.nan * np.asarray(b))


def scenes():
    ventricle = em.scenes.left_ventricle(4, 8, 1, order=1)
    follower = replace(ventricle, loads=(FollowerPressure("endocardium"),), origin={})
    return {
        "definite": ventricle,
        "twisted far": em.scenes.twisting_cube(cells=3, degrees=170.0, order=1),
        "mean dilatation": nearly_incompressible("P2, mean dilatation"),
        "not symmetric": follower,
    }


@pytest.mark.slow
@pytest.mark.usefixtures("petsc")
@pytest.mark.parametrize("name", ["definite", "twisted far", "mean dilatation", "not symmetric"])
def test_solutions_are_those_of_suitesparse(name):
    scene = scenes()[name]
    theta = scene.centre
    usual, other = em.Simulator(scene), em.Simulator(scene, factorisation="petsc")
    expected, found = usual.solve(theta), other.solve(theta)
    assert expected.converged
    assert found.converged
    size = float(jnp.abs(expected.displacement).max())
    np.testing.assert_allclose(found.displacement, expected.displacement, atol=1e-9 * size)
    slopes = usual.sensitivities(expected.displacement, theta)
    by_petsc = other.sensitivities(expected.displacement, theta)
    np.testing.assert_allclose(by_petsc, slopes, atol=1e-9 * float(jnp.abs(slopes).max()))


@pytest.mark.slow
@pytest.mark.usefixtures("petsc")
def test_gradients_and_stability_inside_and_outside_jit():
    scene = block(cells=(3, 2, 2))
    usual, other = em.Simulator(scene), em.Simulator(scene, factorisation="petsc")

    def gradient(simulator):
        return jax.grad(lambda theta: jnp.sum(simulator.solve(theta).displacement ** 2))

    expected = gradient(usual)(scene.centre)
    np.testing.assert_allclose(gradient(other)(scene.centre), expected, rtol=1e-9)
    np.testing.assert_allclose(jax.jit(gradient(other))(scene.centre), expected, rtol=1e-9)
    u = other(scene.centre)
    assert other.is_stable(u, scene.centre) == usual.is_stable(u, scene.centre)


@pytest.mark.slow
@pytest.mark.usefixtures("petsc")
def test_a_kept_factor_serves_from_python(monkeypatch):
    """As on a large mesh: conjugate gradients, from Python, beside a factor of MUMPS."""
    scene = em.scenes.left_ventricle(4, 8, 1, order=1)
    expected = em.Simulator(scene)(scene.centre)
    monkeypatch.setattr(KeptFactor, "pays", staticmethod(lambda pattern: True))
    monkeypatch.setattr("emulator.fem.linear.reuse._LARGE", 300)
    simulator = em.Simulator(scene, factorisation="petsc")
    found = simulator.solve(scene.centre)
    assert found.converged
    np.testing.assert_allclose(found.displacement, expected, atol=1e-7)
    kept = simulator.system.kept
    assert kept is not None
    assert 1 <= kept.factorisations < found.factorisations
