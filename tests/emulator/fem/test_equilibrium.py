from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.fallbacks import find_equilibrium
from emulator.fem.linear import Outcome
from emulator.fem.load_stepping import LoadStepping
from emulator.scenes.loads import Gravity


def by_python(simulator, theta, start=None):
    """The loop in Python, as where a factor is kept or the solver is on the host."""
    start = simulator.rest if start is None else start
    return find_equilibrium(simulator.system, simulator.options, theta, start)


@pytest.mark.parametrize("scene", ["beam", "cube"])
def test_python_s_loop_takes_the_steps_of_the_compiled_one(scene, request):
    scene = request.getfixturevalue(scene)
    simulator = em.Simulator(scene)
    one, other = simulator.solve(scene.centre), by_python(simulator, scene.centre)
    assert one.converged
    assert int(one.iterations) == int(other.iterations)
    assert int(one.factorisations) == int(other.factorisations)
    size = float(jnp.abs(one.displacement).max())
    np.testing.assert_allclose(one.displacement, other.displacement, atol=1e-12 * size)


def test_an_indefinite_tangent_is_solved_another_way(cube, monkeypatch):
    simulator, theta = em.Simulator(cube), cube.centre
    expected, attempt = simulator(theta), System.attempt
    calls = []  # a scene without ramps is on its last route at once

    def refuse_twice(self, tangent, rhs, accuracy):
        calls.append(1)
        x, outcome = attempt(self, tangent, rhs, accuracy)
        if len(calls) <= 2:
            return jnp.full_like(x, jnp.nan), jnp.asarray(Outcome.INDEFINITE, jnp.int32)
        return x, outcome

    monkeypatch.setattr(System, "attempt", refuse_twice)
    np.testing.assert_allclose(by_python(simulator, theta).displacement, expected, atol=1e-9)
    assert len(calls) > 2  # CHOLMOD was asked again


def test_other_errors_are_not_swallowed(cube, monkeypatch):
    simulator = em.Simulator(cube)

    def fail(*arguments, **named):
        raise jax.errors.JaxRuntimeError("out of memory")

    monkeypatch.setattr(System, "attempt", fail)
    with pytest.raises(jax.errors.JaxRuntimeError, match="out of memory"):
        by_python(simulator, cube.centre)


def test_good_tangents_are_kept(beam):
    simulator = em.Simulator(beam)
    cold = simulator.solve(beam.centre)
    warm = simulator.solve(beam.centre * 1.01, cold.displacement)
    assert warm.factorisations < warm.iterations
    assert cold.factorisations < cold.iterations


@pytest.mark.parametrize("scene", ["beam", "cube"])
def test_the_residual_of_round_off_is_that_of_a_stretch_by_round_off(scene, request):
    """A finite stretch stands for the derivative: 1e-15 |K0 X|."""
    scene = request.getfixturevalue(scene)
    system, X = em.Simulator(scene).system, jnp.asarray(scene.mesh.nodes)
    internal = lambda u: system.internal_force(u, scene.centre)
    _, force = jax.jvp(internal, (0.0 * X,), (X,))
    newton = LoadStepping(system, em.fem.NewtonOptions(absolute=0.0), scene.centre)
    expected = 1e-15 * float(jnp.linalg.norm(force))
    assert float(newton.begin(0.0 * X).round_off.residual) == pytest.approx(expected, rel=1e-4)


def test_one_iteration_is_a_function_of_its_state(beam):
    system = em.Simulator(beam).system
    newton = LoadStepping(system, em.fem.NewtonOptions(), beam.centre)
    begin = newton.begin(jnp.zeros(beam.held.shape))
    one, again = newton.step(begin), newton.step(begin)
    np.testing.assert_array_equal(one.u, again.u)
    assert int(begin.iterations) == 0
    assert int(one.iterations) == 1


def test_a_constant_theta_inside_jit_takes_the_closed_loop(cube):
    simulator = em.Simulator(cube)
    inside = jax.jit(lambda scale: scale * simulator.solve(cube.centre).displacement)(2.0)
    np.testing.assert_allclose(inside, 2.0 * simulator(cube.centre), atol=1e-8)


@pytest.fixture(scope="module")
def ventricle():
    return em.Simulator(em.scenes.left_ventricle(rings=4, around=8, layers=1, order=1))


@pytest.mark.slow
@pytest.mark.optimised
def test_sensitivities_against_central_differences(ventricle):
    """Every entry of theta, the pressure among them."""
    scene = ventricle.scene
    u = ventricle(scene.centre)
    columns = ventricle.sensitivities(u, scene.centre)
    for k in range(len(scene.parameters)):
        step = jnp.zeros_like(scene.centre).at[k].set(1e-4 * scene.centre[k])
        ahead, behind = (ventricle.solve(scene.centre + s, u).displacement for s in (step, -step))
        expected = (ahead - behind) / (2.0 * step[k])
        np.testing.assert_allclose(columns[k], expected, atol=1e-6 * jnp.abs(expected).max())


def test_gradients_inside_and_outside_jit_are_the_same(beam):
    simulator = em.Simulator(beam)

    def squared(theta):
        return jnp.sum(simulator.solve(theta).displacement ** 2)

    slope = jax.grad(squared)(beam.centre)
    np.testing.assert_allclose(slope, jax.jit(jax.grad(squared))(beam.centre), rtol=1e-8)


@pytest.mark.slow
def test_sensitivities_where_cholesky_is_refused(ventricle):
    """Away from equilibrium the tangent may be indefinite; the equation still has to hold."""
    theta = ventricle.scene.centre
    blown = 0.9 * ventricle(theta)
    soft = theta.at[:4].multiply(0.3).at[4].multiply(10.0)
    system = ventricle.system
    nothing = jnp.zeros(len(system.free))
    assert system.attempt(ventricle.tangent(blown, soft), nothing)[1] == Outcome.INDEFINITE
    columns = ventricle.sensitivities(blown, soft)
    forces = jax.jit(jax.jacfwd(lambda t: system.residual(blown, t)))(soft)
    # Compiled whole: one by one, the operations of a residual take minutes to compile.
    along = jax.jit(lambda v: jax.jvp(lambda u: system.residual(u, soft), (blown,), (v,))[1])
    for k in range(len(theta)):
        balanced = along(columns[k])
        np.testing.assert_allclose(balanced, -forces[:, k], atol=1e-8 * jnp.abs(forces).max())


def test_load_steps_follow_the_loading_path(beam):
    whole, path = em.Simulator(beam), em.Simulator(beam, em.fem.NewtonOptions.load_steps(5))
    one, five = whole.solve(beam.centre), path.solve(beam.centre)
    assert five.converged
    assert int(five.iterations) >= 10  # two or more a step
    np.testing.assert_allclose(one.displacement, five.displacement, atol=1e-9)


@pytest.mark.slow
def test_a_soft_ventricle_ends_where_loading_leads():
    """Fibres go slack here, and there are several equilibria: 0.3 mL and 3.6 mm apart."""
    scene = em.scenes.left_ventricle(order=1)
    theta = scene.theta(a=0.316, b=1.0, a_f=3.0, b_f=1.0, pressure=1.333)
    from_rest = em.Simulator(scene).solve(theta)
    path = em.Simulator(scene, em.fem.NewtonOptions.load_steps(10)).solve(theta)
    assert from_rest.converged
    assert path.converged
    np.testing.assert_allclose(from_rest.displacement, path.displacement, atol=1e-6)


@pytest.mark.parametrize("steps", [0, 1000])
def test_load_steps_out_of_range(steps):
    with pytest.raises(InputError, match=r"load (steps|increment)"):
        em.fem.NewtonOptions.load_steps(steps)


def test_a_small_residual_alone_is_no_equilibrium(beam):
    """1e-15 |K X| is more than the weight of a needle, which bends all the same."""
    needle = replace(beam.mesh, nodes=beam.mesh.nodes * np.array([200.0, 0.1, 0.1]))
    scene = replace(beam, mesh=needle, loads=(Gravity(1e-9),), origin={})
    simulator = em.Simulator(scene)
    newton = LoadStepping(simulator.system, simulator.options, scene.centre)
    rest = newton.begin(jnp.zeros(scene.held.shape))
    assert float(jnp.linalg.norm(newton.step(rest).residual)) < float(rest.round_off.residual)
    found = simulator.solve(scene.centre).require_converged().displacement
    correction = newton.step(newton.begin(found)).u - found
    assert np.abs(correction).max() < 1e-5 * np.abs(found).max()
