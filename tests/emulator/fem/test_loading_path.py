"""One equilibrium for every route: Python, jit, vmap, cold and warm."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.fem.loading_path import LoadingPath, Route
from emulator.scenes import Support
from emulator.scenes.loads.dead import Gravity
from scene_support import block


@pytest.fixture(scope="module")
def ventricle_simulator(ventricle):
    return em.Simulator(ventricle)


@pytest.fixture(scope="module")
def inside_jit(ventricle_simulator):
    return jax.jit(ventricle_simulator.solve)


def routes(simulator, theta, start):
    """The routes that the steps of the search take, by name."""
    path = LoadingPath(simulator.system, simulator.options, theta)
    ramp, newton = jax.jit(path.ramp_step), jax.jit(path.newton_step)
    state, seen = path.begin(start), []
    while bool(state.running):
        kind = "ramp" if bool(state.ramping) else "newton"
        seen.append((int(state.route), kind))
        state = (ramp if kind == "ramp" else newton)(state)
    return list(dict.fromkeys(seen)), state


def test_from_rest_up_a_ramp_then_newton(ventricle_simulator, inside_jit):
    theta = ventricle_simulator.scene.centre
    seen, state = routes(ventricle_simulator, theta, ventricle_simulator.rest)
    assert seen == [(Route.RAMP, "ramp"), (Route.RAMP, "newton")]
    inside = inside_jit(theta)
    assert inside.iterations == state.newton.iterations
    np.testing.assert_allclose(inside.displacement, state.newton.u, atol=1e-10)


def test_jit_takes_the_iterations_that_python_takes(ventricle_simulator, inside_jit):
    theta = ventricle_simulator.scene.centre
    python, inside = ventricle_simulator.solve(theta), inside_jit(theta)
    assert python.iterations == inside.iterations
    assert python.factorisations == inside.factorisations
    np.testing.assert_allclose(python.displacement, inside.displacement, atol=1e-9)


def test_a_warm_start_whose_way_is_not_convex_is_left_for_rest(ventricle_simulator, inside_jit):
    """A state balanced well enough to be tried, far off the loading path."""
    scene = ventricle_simulator.scene
    theta = scene.centre
    expected = ventricle_simulator(theta)
    start = -0.5 * expected  # a ventricle sucked empty
    seen, _ = routes(ventricle_simulator, theta, start)
    assert seen[0][0] != Route.WARM
    for solve in (ventricle_simulator.solve, inside_jit):
        np.testing.assert_allclose(solve(theta, start).displacement, expected, atol=1e-8)


def test_a_good_warm_start_is_kept(ventricle_simulator):
    scene = ventricle_simulator.scene
    theta = scene.centre
    seen, _ = routes(ventricle_simulator, theta, ventricle_simulator(1.01 * theta))
    assert [route for route, _ in seen] == [Route.WARM]


def test_a_scene_without_ramps_goes_from_warm_to_rest(beam, simulator):
    theta = beam.centre
    seen, state = routes(simulator, theta, -simulator(theta))
    assert {route for route, _ in seen} <= {Route.WARM, Route.CLIMB}
    np.testing.assert_allclose(state.newton.u, simulator(theta), atol=1e-8)


@pytest.mark.parametrize("pressure", [0.0, 1e-13])
def test_a_ventricle_without_pressure_rests(ventricle_simulator, inside_jit, pressure):
    theta = ventricle_simulator.scene.centre
    u = ventricle_simulator(theta)
    empty = theta.at[-1].set(pressure)
    for solve in (ventricle_simulator.solve, inside_jit):
        for start in (ventricle_simulator.rest, 0.01 * u, u):
            solution = solve(empty, start)
            assert solution.converged
            np.testing.assert_allclose(solution.displacement, 0.0, atol=1e-10)


def test_sensitivities_without_pressure_are_the_compliance(ventricle_simulator):
    """Of the moduli nothing depends; on the pressure, as on a small one."""
    theta = ventricle_simulator.scene.centre.at[-1].set(0.0)
    columns = ventricle_simulator.sensitivities(ventricle_simulator.rest, theta)
    np.testing.assert_array_equal(columns[:-1], 0.0)
    small = ventricle_simulator(theta.at[-1].set(1e-5)) / 1e-5
    np.testing.assert_allclose(columns[-1], small, atol=1e-3 * jnp.abs(small).max())
    together = jax.jit(jax.jacfwd(lambda t: ventricle_simulator.solve(t).displacement))(theta)
    np.testing.assert_allclose(together[..., -1], columns[-1], atol=1e-9)


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
