from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
import journeys
from emulator.core.errors import InputError, SolverError
from emulator.geometry.generators.box import box
from emulator.scenes import Support
from emulator.scenes.loads import FollowerPressure, Gravity
from scene_support import block, slope


def test_the_law_is_eleven_frames_from_the_call():
    frames = journeys.solve().frames
    assert frames[0].function == "Simulator.solve"
    assert frames[-1].file.startswith("emulator/mechanics/laws/")
    assert len(frames) <= 11


@pytest.mark.optimised
def test_patch_test():
    """An affine displacement of the surface is an affine displacement throughout."""
    H = 0.2 * np.random.default_rng(0).normal(size=(3, 3))
    scene = block(cells=(3, 3, 3))
    faces = ("left", "right", "front", "back", "bottom", "top")
    supports = tuple(
        Support(face, scene.mesh.nodes[scene.mesh.node_set(face)] @ H.T) for face in faces
    )
    scene = replace(scene, supports=supports)
    assert not scene.held.all()
    u = em.Simulator(scene)(scene.centre)
    np.testing.assert_allclose(u, scene.mesh.nodes @ H.T, atol=1e-12)


@pytest.mark.optimised
def test_a_hanging_block_carries_its_weight():
    """Reactions at the support balance the load: equilibrium of the whole body."""
    scene = block(loads=(Gravity(density=5.0, direction=(0.3, -0.2, -1.0)),))
    simulator = em.Simulator(scene)
    u = simulator(scene.centre)
    weight = simulator.system.dead_force(scene.centre)
    reaction = simulator.system.internal_force(u, scene.centre) - weight
    np.testing.assert_allclose(reaction.sum(axis=0), -weight.sum(axis=0), atol=1e-10)
    np.testing.assert_array_equal(u[scene.mesh.node_set("left")], 0.0)


@pytest.mark.optimised
def test_the_solution_minimises_the_energy(beam, simulator):
    u = simulator(beam.centre)
    Pi = em.fem.potential_energy(beam)
    rng = np.random.default_rng(0)
    for _ in range(5):
        v = jnp.where(beam.held, 0.0, 1e-3 * rng.normal(size=u.shape))
        assert Pi(u + v, beam.centre) > Pi(u, beam.centre)


@pytest.mark.optimised
def test_tangent_is_the_derivative_of_the_residual(simulator, beam):
    system = simulator.system
    rng = np.random.default_rng(1)
    u = simulator(beam.centre) + jnp.where(beam.held, 0.0, 0.01 * rng.normal(size=beam.held.shape))
    direction = rng.normal(size=len(system.free))
    values = np.asarray(system.tangent(u, beam.centre))
    K = np.zeros((system.pattern.size,) * 2)
    rows, columns, both = system.pattern.both(values)
    K[rows, columns] = both
    product = jax.jvp(
        lambda v: system.residual(v, beam.centre), (u,), (system.extend(jnp.asarray(direction)),)
    )[1]
    np.testing.assert_allclose(K @ direction, product, rtol=1e-9, atol=1e-9 * np.abs(product).max())
    np.testing.assert_allclose(
        system.solve(jnp.asarray(values), product), direction, rtol=1e-7, atol=1e-8
    )


@pytest.mark.optimised
def test_gradient_in_theta_against_central_differences(beam, simulator):
    theta = beam.theta(mu=63.0, lam=88.0)
    weights = jnp.asarray(np.random.default_rng(2).normal(size=beam.held.shape))
    f = lambda t: jnp.vdot(weights, simulator.solve(t).displacement)
    h = 1e-3
    central = [(f(theta.at[k].add(h)) - f(theta.at[k].add(-h))) / (2 * h) for k in range(2)]
    reverse = jax.grad(f)(theta)
    forward = jax.jacfwd(f)(theta)
    np.testing.assert_allclose(reverse, central, rtol=1e-6)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)


@pytest.mark.optimised
def test_taylor_remainder_in_theta(beam, simulator):
    theta, direction = beam.theta(mu=63.0, lam=70.0), jnp.array([1.0, -0.7])
    u, slope_u = jax.jvp(lambda t: simulator.solve(t).displacement, (theta,), (direction,))
    steps = 4.0 / 2.0 ** np.arange(5)
    value = [jnp.linalg.norm(simulator(theta + h * direction) - u - h * slope_u) for h in steps]
    assert slope(steps, np.array(value)) == pytest.approx(2.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.optimised
def test_vmap_equals_one_at_a_time(beam, simulator):
    thetas = beam.from_unit(jnp.asarray(np.random.default_rng(0).uniform(size=(4, 2))))
    together = jax.vmap(simulator.solve)(thetas)
    assert (together.status == em.fem.Status.CONVERGED).all()
    for theta, u in zip(thetas, together.displacement, strict=True):
        np.testing.assert_allclose(simulator(theta), u, atol=1e-7)
    pulled = jax.vmap(jax.grad(lambda t: jnp.sum(simulator.solve(t).displacement)))(thetas)
    alone = [jax.grad(lambda t: jnp.sum(simulator.solve(t).displacement))(t) for t in thetas]
    np.testing.assert_allclose(pulled, jnp.stack(alone), rtol=1e-6)


def test_a_warm_start_saves_iterations_and_changes_nothing(beam, simulator):
    cold = simulator.solve(beam.centre)
    warm = simulator.solve(beam.centre * 1.01, cold.displacement)
    again = simulator.solve(beam.centre * 1.01)
    assert warm.iterations < again.iterations
    np.testing.assert_allclose(warm.displacement, again.displacement, atol=1e-8)
    assert simulator.solve(beam.centre, cold.displacement).iterations == 0


@pytest.mark.optimised
def test_newton_converges_quadratically(beam, simulator):
    system, theta = simulator.system, beam.centre
    u = simulator(theta) + jnp.where(beam.held, 0.0, 0.02)
    errors = []
    for _ in range(4):
        u = u - system.extend(system.solve(system.tangent(u, theta), system.residual(u, theta)))
        errors.append(float(jnp.max(jnp.abs(u - simulator(theta)))))
    assert errors[1] < errors[0] ** 1.5
    assert errors[-1] < 1e-10


@pytest.mark.optimised
def test_prescribed_displacements_are_met_exactly(cube):
    solution = em.Simulator(cube).solve(cube.centre)
    assert solution.converged
    np.testing.assert_array_equal(
        np.asarray(solution.displacement)[cube.held], cube.held_displacement[cube.held]
    )


@pytest.mark.optimised
def test_a_heavy_load_is_taken_in_steps():
    scene = em.scenes.twisting_cube(cells=4, degrees=170.0, order=1)
    one = em.Simulator(scene, em.fem.NewtonOptions(level_iterations=7))
    solution = one.solve(scene.theta(E=5.0, nu=0.4))
    assert solution.converged
    assert solution.iterations > 7  # the first attempt, the whole load at once, was given up
    assert one.system.relative_residual(solution.displacement, scene.theta(E=5.0, nu=0.4)) < 1e-8


def test_failures_have_names(beam, simulator):
    bad = simulator.solve(jnp.array([jnp.nan, 60.0]))
    assert bad.status == em.fem.Status.INVALID_INPUT
    assert np.isfinite(bad.displacement).all()
    with pytest.raises(SolverError, match="theta or the starting displacement is not finite"):
        simulator(jnp.array([jnp.nan, 60.0]))
    short = em.Simulator(beam, em.fem.NewtonOptions(max_iterations=2)).solve(beam.centre)
    assert short.status == em.fem.Status.ITERATION_LIMIT
    assert np.isfinite(short.displacement).all()
    with pytest.raises(SolverError, match=r"iteration limit reached \(converged up to 0 % of it\)"):
        short.require_converged()


def test_arguments_of_the_wrong_shape_are_refused(beam, simulator):
    with pytest.raises(InputError, match=r"theta has shape \(1,\); expected \(2,\)"):
        simulator.solve(jnp.array([60.0]))
    with pytest.raises(InputError, match=r"theta has shape \(3,\)"):
        jax.jit(simulator.solve)(jnp.array([60.0, 60.0, 60.0]))
    with pytest.raises(InputError, match=r"start has shape \(3,\)"):
        simulator.solve(beam.centre, jnp.zeros(3))


@pytest.mark.parametrize("kind", [np.float32, int])
def test_a_start_of_another_type_is_taken(beam, simulator, kind):
    start = np.asarray(simulator(beam.centre)).astype(kind)
    np.testing.assert_allclose(
        simulator.solve(beam.centre, start).displacement, simulator(beam.centre), atol=1e-8
    )


def test_an_impossible_load_ends_in_a_named_failure():
    # Turned through half a circle and squeezed flat: no admissible state exists.
    scene = block(cells=(2, 2, 2))
    scene = replace(scene, supports=(Support("left"), Support("right", np.array([-2.5, 0.0, 0.0]))))
    solution = em.Simulator(scene).solve(scene.centre)
    assert solution.status == em.fem.Status.INVERTED_ELEMENT
    assert 0.0 < solution.load_reached < 1.0
    assert np.isfinite(solution.displacement).all()
    with pytest.raises(SolverError, match=r"an element would invert.*converged up to \d"):
        solution.require_converged()


def test_an_inverted_start_is_replaced_by_rest(beam, simulator):
    start = -3.0 * jnp.asarray(beam.mesh.nodes)
    solution = simulator.solve(beam.centre, start)
    assert solution.converged
    np.testing.assert_allclose(solution.displacement, simulator(beam.centre), atol=1e-8)


def test_a_body_at_rest_without_loads():
    scene = block()
    solution = em.Simulator(scene).solve(scene.centre)
    assert solution.converged
    assert solution.iterations == 0


def test_a_singular_tangent_has_a_name():
    scene = block(loads=(Gravity(),))
    solution = em.Simulator(scene).solve(jnp.array([0.0, 0.0]))  # no stiffness at all
    assert solution.status == em.fem.Status.SINGULAR_TANGENT
    with pytest.raises(SolverError, match="singular tangent"):
        solution.require_converged()


@pytest.mark.parametrize("theta", [(0.0, 0.0), (0.0, 5.0), (1e-320, 1e-320)])
def test_a_singular_tangent_does_not_raise_inside_jit(theta):
    scene = block(loads=(Gravity(),))
    simulator = em.Simulator(scene)
    solution = jax.jit(simulator.solve)(jnp.array(theta))
    assert solution.status == em.fem.Status.SINGULAR_TANGENT
    assert np.isfinite(solution.displacement).all()


def test_the_solvers_blas_has_one_thread(simulator):
    from threadpoolctl import threadpool_info

    simulator(simulator.scene.centre)
    threads = [p["num_threads"] for p in threadpool_info() if "sparsax" in p["filepath"]]
    assert threads
    assert set(threads) == {1}


def test_nothing_to_solve_is_said():
    scene = block(supports=(Support("left"), Support("right")), cells=(1, 1, 1))
    with pytest.raises(InputError, match="every node is held"):
        em.Simulator(scene).solve(scene.centre)


@pytest.mark.parametrize(("shortening", "stable"), [(0.0005, True), (0.15, False)])
def test_a_column_beyond_buckling_is_a_saddle(shortening, stable):
    """Perfect, so it stays straight; slenderness 20, where Euler's limit is 0.8 %."""
    scene = replace(
        block(),
        mesh=box((20.0, 1.0, 1.0), (16, 2, 2)),
        supports=(Support("left"), Support("right", (-20.0 * shortening, 0.0, 0.0))),
    )
    simulator = em.Simulator(scene)
    solution = simulator.solve(scene.centre)
    assert solution.converged
    assert simulator.is_stable(solution.displacement, scene.centre) is stable


def test_what_is_no_equilibrium_is_not_stable(beam):
    simulator = em.Simulator(beam)
    inverted = jnp.where(beam.held, 0.0, 100.0 * jax.random.normal(jax.random.key(0), (45, 3)))
    assert not simulator.is_stable(inverted, beam.centre)
    assert not simulator.is_stable(inverted * jnp.nan, beam.centre)


def test_without_an_energy_there_is_no_least():
    scene = block(loads=(FollowerPressure("top", 0.5),))
    with pytest.raises(InputError, match="has no potential"):
        em.Simulator(scene).is_stable(jnp.zeros(scene.held.shape), scene.centre)
