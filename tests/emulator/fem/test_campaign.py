from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.errors import SolverError
from emulator.fem import run_campaign, sobol
from emulator.fem.solution import Status
from emulator.scenes.loads import Gravity
from emulator.surrogates.taylor import constant, expand
from scene_support import block


@pytest.fixture(scope="module")
def simulator():
    return em.Simulator(block(loads=(Gravity(density=150.0),), cells=(2, 1, 1)))


@pytest.fixture(scope="module")
def thetas(simulator):
    return sobol(simulator.scene, 6, seed=0)


@pytest.fixture
def solves(monkeypatch):
    """Start and solution of every solve."""
    seen = []
    solve = em.Simulator.solve

    def watched(self, theta, start=None):
        seen.append((start, solve(self, theta, start)))
        return seen[-1][1]

    monkeypatch.setattr(em.Simulator, "solve", watched)
    return seen


def test_slopes_against_differences(simulator, thetas):
    """In the position, on a log scale and on a uniform one."""
    scene = simulator.scene
    uniform = replace(scene.parameters[1], scale="uniform")
    mixed = em.Simulator(replace(scene, parameters=(scene.parameters[0], uniform)))
    runs = run_campaign(mixed, thetas[:2], slopes=True)
    x = mixed.scene.to_unit(runs.theta)[1]
    for k, step in enumerate(1e-4 * jnp.eye(2)):
        ahead, behind = (mixed(mixed.scene.from_unit(x + s)) for s in (step, -step))
        expected = (ahead - behind) / 2e-4
        atol = 1e-6 * float(jnp.abs(expected).max())
        np.testing.assert_allclose(runs.slopes[1, k], expected, atol=atol)


def test_better_starts_save_iterations_and_change_nothing(simulator, thetas, solves):
    def iterations(**options):
        solves.clear()
        runs = run_campaign(simulator, thetas, **options)
        assert len(solves) == len(thetas)
        return runs, sum(int(solution.iterations) for _, solution in solves)

    plain, nearest = iterations()
    moved, along = iterations(slopes=True)
    expanded, series = iterations(predictor=expand(simulator, order=2))
    assert along < nearest
    assert series < nearest
    for runs in (moved, expanded):
        np.testing.assert_allclose(runs.displacement, plain.displacement, atol=1e-8)
        np.testing.assert_allclose(runs.energy, plain.energy, rtol=1e-8)
    assert plain.slopes is None
    assert moved.take(slice(2)).slopes.shape == (2, 2, *simulator.scene.held.shape)
    assert expanded.take(np.array([3])).slopes is None


def test_an_expansion_that_crushes_elements_is_not_chosen(simulator, thetas, solves):
    """All its nodes in one point; the neighbour, however far, is the better start."""
    crushed = constant(np.full(2, 0.5), -jnp.asarray(simulator.scene.mesh.nodes))
    runs = run_campaign(simulator, thetas[:2], predictor=crushed)
    assert len(runs.theta) == 2
    start, solution = solves[-1]
    np.testing.assert_array_equal(start, runs.displacement[0])
    assert solution.converged


def test_where_a_start_fails_rest_is_tried(simulator, thetas, monkeypatch):
    solve, starts = em.Simulator.solve, []

    def shy(self, theta, start=None):
        starts.append(start)
        solution = solve(self, theta)
        status = solution.status if start is None else jnp.asarray(Status.LOAD_LIMIT)
        return solution._replace(status=status)

    monkeypatch.setattr(em.Simulator, "solve", shy)
    runs = run_campaign(simulator, thetas[:3])
    assert [start is None for start in starts] == [True, False, True, False, True]
    assert jnp.isfinite(runs.displacement).all()


def test_a_failure_names_the_run(simulator, thetas):
    with pytest.raises(SolverError, match="FEM run 1: theta or the starting displacement is not"):
        run_campaign(simulator, thetas[:2].at[1, 0].set(jnp.nan), slopes=True)


def test_slopes_are_those_of_the_solver(simulator, thetas):
    runs = run_campaign(simulator, thetas[:1], slopes=True)
    scene = simulator.scene
    _, along = jax.jvp(
        lambda x: simulator.solve(scene.from_unit(x)).displacement,
        (scene.to_unit(thetas[0]),),
        (jnp.array([1.0, -2.0]),),
    )
    np.testing.assert_allclose(runs.slopes[0, 0] - 2.0 * runs.slopes[0, 1], along, atol=1e-10)


@pytest.mark.parametrize("at_least", [1, 4])
def test_after_the_deadline_only_the_fewest_are_begun(simulator, thetas, at_least):
    runs = run_campaign(simulator, thetas, deadline=0.0, at_least=at_least)
    assert len(runs.theta) == len(runs.displacement) == len(runs.energy) == at_least
