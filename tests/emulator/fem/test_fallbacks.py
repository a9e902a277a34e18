"""One equilibrium for every strategy: Python, jit, vmap, cold and warm."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.fem.fallbacks import EquilibriumSearch
from emulator.scenes import Support
from emulator.scenes.loads import Gravity
from scene_support import block


@pytest.fixture(scope="module")
def ventricle_simulator(ventricle):
    return em.Simulator(ventricle)


@pytest.fixture(scope="module")
def inside_jit(ventricle_simulator):
    return jax.jit(ventricle_simulator.solve)


SOFT = [
    # jit ended 12.5 to 15.8 mm from Python's equilibrium, both converged
    (0.2153, 1.1541, 3.4823, 1.0086, 1.3036),
    (0.2237, 1.0179, 3.4797, 1.3072, 1.3278),
    (0.2045, 1.0336, 3.4427, 1.2098, 1.2683),
    # outside the box; 8.9 mm apart where only the sign of a ramp step's slope was asked
    (0.1801, 0.8969, 2.5108, 1.1495, 1.4239),
]


@pytest.mark.parametrize("theta", SOFT)
def test_one_equilibrium_for_python_jit_and_warm_starts(ventricle_simulator, inside_jit, theta):
    """Where fibres go slack there are several equilibria."""
    theta = jnp.array(theta)
    cold, inside = ventricle_simulator.solve(theta), inside_jit(theta)
    assert cold.converged
    assert inside.converged
    np.testing.assert_allclose(inside.displacement, cold.displacement, atol=1e-6)
    far = ventricle_simulator(ventricle_simulator.scene.centre)
    warm = ventricle_simulator.solve(theta, far)
    np.testing.assert_allclose(warm.displacement, cold.displacement, atol=1e-6)


@pytest.mark.slow
def test_the_soft_corner_of_the_linear_ventricle():
    """Python, jit and 40 load steps, where they differed by 1.7 to 4.3 mm."""
    scene = em.scenes.left_ventricle(order=1)
    simulator = em.Simulator(scene)
    path = em.Simulator(scene, em.fem.NewtonOptions.load_steps(40))
    inside = jax.jit(simulator.solve)
    rng = np.random.default_rng(11)
    soft = rng.uniform(size=(60, 5)) * np.array([0.6, 0.2, 0.2, 0.2, -0.25])
    soft[:, 4] += 1.0
    for k in (1, 10, 11, 17):
        theta = scene.from_unit(jnp.asarray(soft[k]))
        expected = path.solve(theta).displacement
        for solve in (simulator.solve, inside):
            np.testing.assert_allclose(solve(theta).displacement, expected, atol=1e-4)


def strategies(simulator, theta, start):
    """The strategies that the steps of the search belong to, and how they iterate."""
    search = EquilibriumSearch(simulator.system, simulator.options, theta)
    step = jax.jit(search.step)
    state, seen = search.begin(search.load_stepping.begin(start)), []
    while bool(state.running):
        if not bool(state.begins):
            seen.append((int(state.strategy), "stress" if bool(state.by_stress) else "newton"))
        state = step(state)
    return list(dict.fromkeys(seen)), state


@pytest.mark.slow
def test_from_rest_by_stress_iterates_then_newton(ventricle_simulator, inside_jit):
    theta = ventricle_simulator.scene.centre
    seen, state = strategies(ventricle_simulator, theta, ventricle_simulator.rest)
    assert seen == [(1, "stress"), (1, "newton")]
    inside = inside_jit(theta)
    assert inside.iterations == state.newton.iterations
    np.testing.assert_allclose(inside.displacement, state.newton.u, atol=1e-10)


def test_the_limit_counts_stress_iterates(ventricle_simulator):
    """From rest the schedule alone takes more than two steps."""
    scene = ventricle_simulator.scene
    solution = em.Simulator(scene, em.fem.NewtonOptions(max_iterations=2)).solve(scene.centre)
    assert solution.status == em.fem.Status.ITERATION_LIMIT
    assert solution.iterations == solution.factorisations == 2
    assert jnp.isfinite(solution.displacement).all()


@pytest.mark.slow
def test_jit_takes_the_iterations_that_python_takes(ventricle_simulator, inside_jit):
    theta = ventricle_simulator.scene.centre
    python, inside = ventricle_simulator.solve(theta), inside_jit(theta)
    assert python.iterations == inside.iterations
    assert python.factorisations == inside.factorisations
    np.testing.assert_allclose(python.displacement, inside.displacement, atol=1e-9)


@pytest.mark.slow
def test_a_warm_start_whose_way_is_not_convex_is_left_for_rest(ventricle_simulator, inside_jit):
    """A state balanced well enough to be tried, far off the loading path."""
    scene = ventricle_simulator.scene
    theta = scene.centre
    expected = ventricle_simulator(theta)
    start = -0.5 * expected  # a ventricle sucked empty
    seen, _ = strategies(ventricle_simulator, theta, start)
    assert seen[-1][0] != 0
    for solve in (ventricle_simulator.solve, inside_jit):
        np.testing.assert_allclose(solve(theta, start).displacement, expected, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("theta", [None, SOFT[0]])
def test_a_rough_start_takes_fewer_steps_than_rest(ventricle_simulator, inside_jit, theta):
    """A field that is right and has rough strains, as a network's: most of the load is unbalanced,
    and the tangent there is indefinite."""
    scene = ventricle_simulator.scene
    theta = scene.centre if theta is None else jnp.array(theta)
    expected = ventricle_simulator.solve(theta)
    rough = 0.1 * np.random.default_rng(0).normal(size=scene.held.shape)
    start = expected.displacement + jnp.where(scene.held, 0.0, rough)
    for solve in (ventricle_simulator.solve, inside_jit):
        solution = solve(theta, start)
        np.testing.assert_allclose(solution.displacement, expected.displacement, atol=1e-8)
        assert 2 * solution.factorisations <= expected.factorisations + 1


@pytest.mark.slow
def test_a_good_warm_start_is_kept(ventricle_simulator):
    scene = ventricle_simulator.scene
    theta = scene.centre
    seen, _ = strategies(ventricle_simulator, theta, ventricle_simulator(1.01 * theta))
    assert [strategy for strategy, _ in seen] == [0]


def test_a_scene_without_stress_iterates_goes_from_the_start_to_rest(beam, simulator):
    theta = beam.centre
    seen, state = strategies(simulator, theta, -simulator(theta))
    assert {strategy for strategy, _ in seen} <= {0, 1}
    np.testing.assert_allclose(state.newton.u, simulator(theta), atol=1e-8)


@pytest.mark.parametrize("pressure", [pytest.param(0.0, marks=pytest.mark.slow), 1e-13])
def test_a_ventricle_without_pressure_rests(ventricle_simulator, inside_jit, pressure):
    theta = ventricle_simulator.scene.centre
    u = ventricle_simulator(theta)
    empty = theta.at[-1].set(pressure)
    for solve in (ventricle_simulator.solve, inside_jit):
        for start in (ventricle_simulator.rest, 0.01 * u, u):
            solution = solve(empty, start)
            assert solution.converged
            np.testing.assert_allclose(solution.displacement, 0.0, atol=1e-10)


@pytest.mark.slow
def test_sensitivities_without_pressure_are_finite(ventricle_simulator, inside_jit):
    """The moduli change nothing. In the pressure the switch of the fibres has a kink at rest, so
    that round-off decides on its side: both are asked at the same displacement."""
    theta = ventricle_simulator.scene.centre.at[-1].set(0.0)
    columns = ventricle_simulator.sensitivities(inside_jit(theta).displacement, theta)
    np.testing.assert_allclose(columns[:-1], 0.0, atol=1e-12)
    assert np.isfinite(columns).all()
    together = jax.jit(jax.jacfwd(lambda t: ventricle_simulator.solve(t).displacement))(theta)
    np.testing.assert_allclose(together[..., -1], columns[-1], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_a_block_without_weight(shift):
    """It rests, or goes where its supports take it; from any start."""
    scene = replace(
        block(loads=(Gravity(density=0.0),)), supports=(Support("left", (shift, 0.0, 0.0)),)
    )
    simulator = em.Simulator(scene)
    expected = jnp.zeros(scene.held.shape).at[:, 0].set(shift)
    solves = (simulator.solve, jax.jit(simulator.solve))
    near = expected + jnp.where(scene.held, 0.0, 0.01)
    for solve in solves:
        for start in (simulator.rest, near):
            solution = solve(scene.centre, start)
            assert solution.converged
            np.testing.assert_allclose(solution.displacement, expected, atol=1e-11)
    together = jax.vmap(simulator.solve)(jnp.stack([scene.centre, 0.9 * scene.centre]))
    assert together.converged.all()
    assert np.isfinite(simulator.sensitivities(simulator.rest, scene.centre)).all()
