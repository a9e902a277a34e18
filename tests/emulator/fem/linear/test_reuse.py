"""A factor that serves other tangents."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.accuracy.estimate import ErrorBar
from emulator.fem.linear import Outcome
from emulator.fem.linear.reuse import Gradients, KeptFactor, conjugate_gradients
from emulator.geometry.generators.box import box
from emulator.scenes import Support
from scene_support import block


@pytest.fixture(scope="module")
def ventricle():
    return em.Simulator(em.scenes.left_ventricle(4, 8, 1, order=1))


def test_gradients_that_do_not_get_there_say_so():
    values = jnp.logspace(0, 6, 200)
    b = jnp.ones(200)
    found = conjugate_gradients(lambda x: values * x, lambda r: r, b, 10, 1e-10, 6)
    assert not found.reduction <= 1e-10
    found = conjugate_gradients(lambda x: values * x, lambda r: r / values, b, 10, 1e-10)
    assert found.reduction <= 1e-10
    assert found.convex
    np.testing.assert_allclose(found.x, b / values)
    assert not conjugate_gradients(lambda x: -x, lambda r: r, b, 10, 1e-10).convex
    nothing = conjugate_gradients(lambda x: x, lambda r: r, 0.0 * b, 10, 1e-10)
    assert nothing.reduction == 0.0
    assert nothing.convex


def test_two_iterations_are_those_of_the_textbook():
    rng = np.random.default_rng(0)
    A, M = (np.eye(6) + 0.1 * (R + R.T) for R in rng.normal(size=(2, 6, 6)))
    left = b = rng.normal(size=6)
    x, p, before = np.zeros(6), 0.0, 1.0
    for k in range(2):
        z = np.linalg.solve(M, left)
        p = z + (left @ z / before if k else 0.0) * p
        before = left @ z
        length = before / (p @ A @ p)
        x, left = x + length * p, left - length * A @ p
    found = conjugate_gradients(
        lambda v: A @ v, lambda r: jnp.linalg.solve(M, r), jnp.asarray(b), 2, 0.0
    )
    np.testing.assert_allclose(found.x, x, rtol=1e-10)
    assert found.convex


@pytest.fixture
def any_mesh_is_large(monkeypatch):
    """Every mesh keeps a factor, as those of 60 000 unknowns and more do."""
    monkeypatch.setattr("emulator.fem.linear.reuse._LEAST", 50)
    monkeypatch.setattr("emulator.fem.linear.reuse._LARGE", 50)


def column(shortening):
    """A slender column between plates: straight it buckles at 0.8 %."""
    return replace(
        block(),
        mesh=box((20.0, 1.0, 1.0), (16, 2, 2)),
        supports=(Support("left"), Support("right", (-20.0 * shortening, 0.0, 0.0))),
    )


@pytest.mark.parametrize(("shortening", "stable"), [(0.0005, True), (0.15, False)])
def test_stability_is_seen_beside_a_kept_factor(any_mesh_is_large, shortening, stable):
    scene = column(shortening)
    simulator = em.Simulator(scene)
    solution = simulator.solve(scene.centre)
    assert solution.converged
    assert simulator.system.kept is not None
    for _ in range(2):  # a factor is there from the second time on at the latest
        assert simulator.is_stable(solution.displacement, scene.centre) is stable
    assert simulator.is_stable(em.Simulator(column(0.0005))(scene.centre), scene.centre)


def test_answers_beside_a_kept_factor_are_those_without(monkeypatch):
    """Every question that is put to a simulator, asked of two theta in turn."""
    scene = em.scenes.left_ventricle(4, 8, 1, order=1)
    thetas = scene.from_unit(jnp.array([[0.5] * 5, [0.6, 0.4, 0.5, 0.55, 0.5]]))

    def answers():
        simulator = em.Simulator(scene)
        path = simulator.path(thetas)
        volume = simulator.gradient_of(lambda u, theta: jnp.sum(u**2))
        found = []
        for theta, u in zip(thetas, path.displacement, strict=True):
            start = simulator.solve(theta, 0.9 * u).displacement
            slopes, gradient = simulator.sensitivities(u, theta), volume(u, theta)
            bar = ErrorBar(em.fem_forward(simulator), simulator)
            step = bar.of_field(0.99 * u, theta)
            found += [u, start, slopes, *gradient, simulator.reactions(u, theta), step.field]
        return simulator, found

    usual, expected = answers()
    monkeypatch.setattr("emulator.fem.linear.reuse._LEAST", 50)
    monkeypatch.setattr("emulator.fem.linear.reuse._LARGE", 50)
    keeping, found = answers()
    assert usual.system.kept is None
    assert keeping.system.kept is not None
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-6 * float(jnp.abs(one).max()))


def test_a_kept_factor_leads_to_the_same_equilibrium(monkeypatch):
    """As on a mesh large enough for it, and with fewer factorisations than tangents."""
    scene = em.scenes.left_ventricle(4, 8, 1, order=1)
    usual = em.Simulator(scene)
    monkeypatch.setattr(KeptFactor, "pays", staticmethod(lambda pattern: True))
    monkeypatch.setattr("emulator.fem.linear.reuse._LARGE", 300)
    keeping = em.Simulator(scene)
    keeping.system.kept  # noqa: B018 - decided while it pays
    monkeypatch.setattr(KeptFactor, "pays", staticmethod(lambda pattern: False))
    tangents = 0
    for position in ([0.5] * 5, [0.55] * 5, [0.6, 0.5, 0.5, 0.5, 0.45], [0.0] * 5):
        theta = scene.from_unit(jnp.asarray(position))
        expected, found = usual.solve(theta), keeping.solve(theta)
        assert found.converged
        assert jnp.abs(found.displacement - expected.displacement).max() < 1e-7
        tangents += int(found.factorisations)
    kept = keeping.system.kept
    assert kept is not None
    assert 1 <= kept.factorisations < tangents


def test_a_kept_factor_refuses_what_is_not_definite(ventricle):
    system, scene = ventricle.system, ventricle.scene
    kept = KeptFactor(system.pattern)
    K = ventricle.tangent(ventricle(scene.centre), scene.centre)
    b = jnp.asarray(np.random.default_rng(0).normal(size=system.pattern.size))
    x, outcome = kept.attempt(K, b, 1e-10)
    assert outcome == Outcome.OK
    np.testing.assert_allclose(
        kept.attempt(1.001 * K, b, 1e-10)[0], x / 1.001, rtol=1e-6, atol=1e-9
    )
    assert kept.factorisations == 1
    diagonal = system.pattern.rows == system.pattern.columns
    x, outcome = kept.attempt(K - K.max() * diagonal, b, 1e-10)
    assert outcome == Outcome.INDEFINITE
    assert jnp.isnan(x).all()


@pytest.mark.parametrize("many", [False, True])
def test_a_factor_that_needs_many_iterations_is_replaced(ventricle, monkeypatch, many):
    kept, scene = KeptFactor(ventricle.system.pattern), ventricle.scene
    K = ventricle.tangent(ventricle(scene.centre), scene.centre)
    b = jnp.ones(ventricle.system.pattern.size)
    kept.attempt(K, b, 0.01)
    iterations = jnp.array(kept._iterations // 2 + many)
    answer = Gradients(b, jnp.array(0.0), iterations, jnp.array(True))
    monkeypatch.setattr(kept, "_solve_beside", lambda *_: answer)
    for _ in range(2):
        kept.attempt(1.001 * K, b, 0.01)
    assert kept.factorisations == 1 + many
