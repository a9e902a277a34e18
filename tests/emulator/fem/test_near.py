"""Solves inside ``jit`` with tangents close to one whose Cholesky factor is known."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

import emulator as em
from emulator.fem.assembly import System
from emulator.fem.factorisations import REFUSALS
from emulator.fem.kept import KeptFactor, conjugate_gradients
from emulator.fem.near import NearSolver
from emulator.scenes.loads import FollowerPressure


@pytest.fixture(scope="module")
def ventricle() -> em.Simulator:
    return em.Simulator(em.scenes.left_ventricle(4, 8, 1, order=1))


@pytest.fixture(scope="module")
def solver(ventricle: em.Simulator) -> NearSolver:
    centre = ventricle.scene.centre
    return ventricle.near(ventricle(centre), centre)


def tangent(solver: NearSolver, position: list[float]) -> np.ndarray:
    """The tangent at rest at ``position`` in the unit box: unlike the reference's state."""
    scene = solver.general.scene
    theta = scene.from_unit(jnp.asarray(position))
    return np.asarray(solver.general.safe_tangent(jnp.zeros(scene.held.shape), theta, 1.0)[0])


def matrix(solver: NearSolver, values: np.ndarray) -> sp.csc_array:
    pattern = solver.general.pattern
    return sp.csc_array((values, (pattern.rows, pattern.columns)), (pattern.size,) * 2)


@pytest.mark.parametrize("position", [[0.5] * 5, [0.9, 0.1, 0.9, 0.1, 0.5], [0.0] * 5])
def test_solutions_are_those_of_another_solver(solver: NearSolver, position: list[float]) -> None:
    K, b = (
        tangent(solver, position),
        np.random.default_rng(0).normal(size=solver.general.pattern.size),
    )
    expected = spsolve(matrix(solver, K), b)
    found = jax.jit(solver.solve)(jnp.asarray(K), jnp.asarray(b))
    assert np.abs(found - expected).max() < 1e-7 * np.abs(expected).max()


def test_indefinite_tangents_are_solved_too(solver: NearSolver) -> None:
    """CHOLMOD raises on them inside jit; here a direction without curvature leads to UMFPACK."""
    pattern = solver.general.pattern
    K = tangent(solver, [0.5] * 5)
    diagonal = pattern.rows == pattern.columns
    K = K - 0.05 * K[diagonal].max() * diagonal
    assert np.linalg.eigvalsh(matrix(solver, K).toarray())[0] < 0.0
    b = np.random.default_rng(0).normal(size=pattern.size)
    expected = spsolve(matrix(solver, K), b)
    found = jax.jit(solver.solve)(jnp.asarray(K), jnp.asarray(b))
    assert np.abs(found - expected).max() < 1e-7 * np.abs(expected).max()


def test_batches_and_transposes(solver: NearSolver) -> None:
    rng = np.random.default_rng(0)
    K = jnp.stack([tangent(solver, [x] * 5) for x in (0.3, 0.7)])
    b = jnp.asarray(rng.normal(size=(2, solver.general.pattern.size)))
    together = jax.jit(jax.vmap(solver.solve))(K, b)
    for each in range(2):
        assert np.allclose(together[each], solver.solve(K[each], b[each]), rtol=1e-9, atol=1e-12)
    # K is symmetric, so the gradient of c . K^-1 b in b is K^-1 c.
    c = jnp.asarray(rng.normal(size=b.shape[1]))
    gradient = jax.jit(jax.grad(lambda b: jnp.vdot(c, solver.solve(K[0], b))))(b[0])
    assert np.allclose(gradient, solver.solve(K[0], c), rtol=1e-9, atol=1e-12)


def test_nothing_in_nothing_out(solver: NearSolver) -> None:
    K = jnp.asarray(tangent(solver, [0.5] * 5))
    assert not np.any(solver.solve(K, jnp.zeros(solver.general.pattern.size)))


def test_a_tangent_no_factor_is_near_to_is_said_to_be_unsolved() -> None:
    """Conjugate gradients never call an answer one whose residual is not small."""
    values = jnp.logspace(0, 6, 200)
    b = jnp.ones(200)
    _, found = conjugate_gradients(lambda x: values * x, lambda r: r, b, 10, 1e-10)
    assert not found
    x, found = conjugate_gradients(lambda x: values * x, lambda r: r / values, b, 10, 1e-10)
    assert found
    assert np.allclose(x, b / values)


def test_without_a_potential_there_is_no_reference(ventricle: em.Simulator) -> None:
    scene = ventricle.scene
    follower = replace(scene, loads=(FollowerPressure("endocardium"),), origin={})
    simulator = em.Simulator(follower)
    assert simulator.near(simulator.rest, follower.centre).reference is None


def test_a_kept_factor_leads_to_the_same_equilibrium(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a mesh large enough for it, and with fewer factorisations than tangents."""
    scene = em.scenes.left_ventricle(4, 8, 1, order=1)
    usual = em.Simulator(scene)
    monkeypatch.setattr(KeptFactor, "pays", staticmethod(lambda pattern: True))
    monkeypatch.setattr("emulator.fem.kept._LARGE", 300)
    monkeypatch.setattr("emulator.fem.kept.remember_factors", lambda count: None)
    keeping = em.Simulator(scene)
    tangents = 0
    for position in ([0.5] * 5, [0.55] * 5, [0.6, 0.5, 0.5, 0.5, 0.45], [0.0] * 5):
        theta = scene.from_unit(jnp.asarray(position))
        expected, found = usual.solve(theta), keeping.solve(theta)
        assert found.converged
        assert jnp.abs(found.displacement - expected.displacement).max() < 1e-7
        tangents += int(found.factorisations)
    kept = keeping._driver.definite.kept
    assert kept is not None
    assert 1 <= kept.factorisations < tangents


def test_a_kept_factor_s_refusal_is_cholmod_s(ventricle: em.Simulator) -> None:
    definite = System(ventricle.scene, "cholmod")
    kept = KeptFactor(definite.pattern)
    u = ventricle(ventricle.scene.centre)
    K, _ = definite.safe_tangent(u, ventricle.scene.centre, 1.0)
    b = jnp.asarray(np.random.default_rng(0).normal(size=definite.pattern.size))
    x = kept.solve(K, b)
    assert np.allclose(kept.solve(1.001 * K, b), x / 1.001, rtol=1e-6, atol=1e-9)
    assert kept.factorisations == 1
    diagonal = definite.pattern.rows == definite.pattern.columns
    with pytest.raises(REFUSALS, match="not positive definite"):
        kept.solve(K - K.max() * diagonal, b)
