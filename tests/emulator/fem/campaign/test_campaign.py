from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import SolverError
from emulator.fem import run_campaign, sobol
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


def test_sensitivities_against_differences(simulator, thetas):
    """du/dtheta in the parameters' own units; in the unit box on a log and on a uniform scale."""
    scene = simulator.scene
    uniform = replace(scene.parameters[1], scale="uniform")
    mixed = em.Simulator(replace(scene, parameters=(scene.parameters[0], uniform)))
    runs = run_campaign(mixed, thetas[:2], sensitivities=True)
    in_box = runs.sensitivities * mixed.scene.space.rates(runs.theta)[..., None, None]
    theta, position = runs.theta[1], mixed.scene.to_unit(runs.theta)[1]
    for k in range(2):
        for found, at, solve in (
            (runs.sensitivities, theta, mixed),
            (in_box, position, lambda x: mixed(mixed.scene.from_unit(x))),
        ):
            step = 1e-4 * at[k]
            ahead, behind = (solve(at.at[k].add(s)) for s in (step, -step))
            expected = (ahead - behind) / (2 * step)
            atol = 1e-6 * float(jnp.abs(expected).max())
            np.testing.assert_allclose(found[1, k], expected, atol=atol)


def test_better_starts_save_iterations_and_change_nothing(simulator, thetas, solves):
    def iterations(**options):
        solves.clear()
        runs = run_campaign(simulator, thetas, **options)
        assert len(solves) == len(thetas)
        return runs, sum(int(solution.iterations) for _, solution in solves)

    plain, nearest = iterations()
    moved, along = iterations(sensitivities=True)
    expanded, series = iterations(predictor=expand(simulator, order=2))
    assert along < nearest
    assert series < nearest
    for runs in (moved, expanded):
        np.testing.assert_allclose(runs.displacement, plain.displacement, atol=1e-8)
        np.testing.assert_allclose(runs.energy, plain.energy, rtol=1e-8)
    assert plain.sensitivities is None
    assert moved.take(slice(2)).sensitivities.shape == (2, 2, *simulator.scene.held.shape)
    assert expanded.take(np.array([3])).sensitivities is None


def test_an_expansion_that_crushes_elements_is_not_chosen(simulator, thetas, solves):
    """All its nodes in one point; the neighbour, however far, is the better start."""
    crushed = constant(np.full(2, 0.5), -jnp.asarray(simulator.scene.mesh.nodes))
    runs = run_campaign(simulator, thetas[:2], predictor=crushed)
    assert len(runs.theta) == 2
    start, solution = solves[-1]
    np.testing.assert_array_equal(start, runs.displacement[0])
    assert solution.converged


def test_a_failure_names_the_run(simulator, thetas):
    with pytest.raises(SolverError, match="FEM run 1: theta or the starting displacement is not"):
        run_campaign(simulator, thetas[:2].at[1, 0].set(jnp.nan), sensitivities=True)


def test_sensitivities_are_the_solvers(simulator, thetas):
    runs = run_campaign(simulator, thetas[:1], sensitivities=True)
    _, along = jax.jvp(
        lambda theta: simulator.solve(theta).displacement, (thetas[0],), (jnp.array([1.0, -2.0]),)
    )
    found = runs.sensitivities[0, 0] - 2.0 * runs.sensitivities[0, 1]
    np.testing.assert_allclose(found, along, atol=1e-10)


@pytest.mark.parametrize("at_least", [1, 4])
def test_after_the_deadline_only_the_fewest_are_begun(simulator, thetas, at_least):
    runs = run_campaign(simulator, thetas, deadline=0.0, at_least=at_least)
    assert len(runs.theta) == len(runs.displacement) == len(runs.energy) == at_least
