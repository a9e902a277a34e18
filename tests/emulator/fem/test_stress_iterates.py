from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.fem.assembly import System
from emulator.fem.fallbacks import find_equilibrium
from emulator.fem.linear import Outcome
from emulator.fem.material_point import MaterialPoint, fractions_at_stress
from emulator.fem.newton import NewtonOptions
from emulator.fem.stress_iterates import StressIterates, applies
from emulator.geometry.generators.box import box
from emulator.mechanics.laws import find_law
from emulator.mechanics.laws.law import Law, modulus
from emulator.scenes import Scene, Support
from emulator.scenes.built_in.ventricles import MYOCARDIUM
from emulator.scenes.tissue import Tissue
from scene_support import block


def mip(scene, theta):
    return StressIterates(System(scene), 0.2, theta, jnp.array(1.0))


@pytest.fixture(scope="module")
def traction_beam():
    """Guccione's law: one exponential of a tensor."""
    return em.scenes.traction_beam_guccione(cells=(12, 2, 2), order=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["traction_beam", "ventricle"])
def test_where_measures_are_those_of_the_displacement_it_is_newton(name, request):
    scene = request.getfixturevalue(name)
    system, theta = System(scene), scene.centre
    u = 0.9999 * em.Simulator(scene)(theta)  # elsewhere the tangent is not definite
    expected = system.extend(system.solve(system.tangent(u, theta), -system.residual(u, theta)))
    own = mip(scene, theta)
    after = jax.jit(own.step)(own.begin(u), jnp.array(1.0))
    assert after.fraction == 1.0
    np.testing.assert_allclose(after.u - u, expected, atol=1e-9 * jnp.abs(expected).max())


def test_stress_and_tangent_of_a_point_whose_measures_are_others(ventricle):
    """Those of quadratic models of the energy, differentiated as functions of H.

    The stress is that of the model about the point's own measures; the tangent weighs the second
    derivatives of the measures with its own stress, as does a model about where H is.
    """
    own, at = MaterialPoint(ventricle, ventricle.centre), Tissue(jnp.array([1.0, 2.0, 2.0]) / 3.0)
    H = 0.1 * jax.random.normal(jax.random.key(1), (3, 3))
    xi = lambda G: own.measures.of(G, at.directions)
    others = 0.5 * jax.jit(xi)(H) + 0.01

    @jax.jit
    def by_models(H, others):
        phi = own.energy(at)
        s, C = jax.grad(phi)(others), jax.hessian(phi)(others)

        def model(about):
            return lambda G: s @ xi(G) + 0.5 * (xi(G) - about) @ C @ (xi(G) - about)

        return jax.grad(model(others))(H), jax.hessian(model(xi(H)))(H)

    stress, tangent, _ = jax.jit(lambda H, others: own.linearise(H, others, at))(H, others)
    expected = by_models(H, others)
    np.testing.assert_allclose(stress, expected[0], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(tangent, expected[1], rtol=1e-10, atol=1e-9)


@pytest.mark.slow
def test_equilibrium_is_a_fixed_point(ventricle):
    theta = ventricle.centre
    u = em.Simulator(ventricle)(theta)
    own = mip(ventricle, theta)
    state = own.begin(u)
    after = jax.jit(own.step)(state, jnp.array(1.0))
    np.testing.assert_allclose(after.u, u, atol=1e-10)
    np.testing.assert_allclose(after.measures, state.measures, atol=1e-10)


@pytest.mark.optimised
def test_it_converges_quadratically(ventricle):
    own, errors = mip(ventricle, ventricle.centre), []
    state, step = own.begin(jnp.zeros(ventricle.held.shape)), jax.jit(own.step)
    for iteration in range(9):
        state = step(state, jnp.array(float(iteration > 0)))
        errors.append(float(state.error))
    assert errors[-1] < 1e-11
    last = [error for error in errors if 1e-10 < error < 0.1]
    assert len(last) >= 3
    assert all(after < 10.0 * before**1.6 for before, after in pairwise(last))


def test_the_fraction_undoes_an_exponential():
    """phi = exp(20 b) / 20 promises stress 1 + 20 for b = 1; the law has it at ln(21) / 20."""
    fraction = fractions_at_stress(1, lambda b: jnp.exp(20.0 * b[0]) / 20.0)
    np.testing.assert_allclose(fraction, np.log(21.0) / 20.0, rtol=1e-9)


@pytest.mark.parametrize(
    "phi",
    [
        lambda b: 0.5 * b**2,  # as promised
        lambda b: jnp.exp(-3.0 * b),  # softer, going down
        lambda b: jnp.maximum(0.2 - b, 0.0) ** 2,  # fibres going slack
        lambda b: 0.0 * b,
    ],
)
def test_a_law_that_does_not_stiffen_goes_all_the_way(phi):
    assert fractions_at_stress(1, lambda b: phi(b[0])) == 1.0


def test_a_law_that_blows_up_on_the_way_is_stopped_short():
    """ln J of an element that its step would turn inside out."""
    fraction = fractions_at_stress(1, lambda b: -jnp.log1p(-3.0 * b[0]))
    # 3 / (1 - 3 b) = 3 + 9
    np.testing.assert_allclose(fraction, 0.25, rtol=1e-9)


def test_parts_that_share_an_exponential():
    """phi = exp(3 a + 5 b) promises nine times its slopes for a = b = 1."""
    fractions = fractions_at_stress(2, lambda b: jnp.exp(3.0 * b[0] + 5.0 * b[1]))
    np.testing.assert_allclose(fractions, np.log(9.0) / 8.0, rtol=1e-9)


def test_a_part_that_overflows_leaves_the_others_alone():
    fractions = fractions_at_stress(2, lambda b: jnp.exp(1000.0 * b[0]) + 0.5 * b[1] ** 2)
    np.testing.assert_allclose(fractions, [np.log(1001.0) / 1000.0, 1.0], rtol=1e-2)


@pytest.mark.slow  # the ventricle's path is followed by Newton's method in test_loading_path, too
@pytest.mark.parametrize("name", ["traction_beam", "ventricle"])
def test_it_ends_where_newton_does(name, request):
    scene = request.getfixturevalue(name)
    theta, options = scene.centre, em.fem.NewtonOptions(stress_iterates=False)
    one, other = em.Simulator(scene).solve(theta), em.Simulator(scene, options).solve(theta)
    assert one.converged
    assert other.converged
    assert int(one.factorisations) <= 6
    np.testing.assert_allclose(one.displacement, other.displacement, atol=1e-8)
    if name == "traction_beam":  # the ventricle is too coarse to be hard for either
        assert one.factorisations < other.factorisations


def by_python(simulator, theta, start=None):
    """The loop in Python, so that its steps can be watched."""
    start = simulator.rest if start is None else start
    return find_equilibrium(simulator.system, simulator.options, theta, start)


@pytest.mark.slow
def test_no_tangent_on_the_way_is_indefinite(ventricle, monkeypatch):
    simulator, outcomes, attempt = em.Simulator(ventricle), [], System.attempt

    def noting(self, tangent, rhs, accuracy):
        x, outcome = attempt(self, tangent, rhs, accuracy)
        outcomes.append(int(outcome))
        return x, outcome

    monkeypatch.setattr(System, "attempt", noting)
    assert by_python(simulator, ventricle.centre).converged
    assert set(outcomes) == {Outcome.OK}


@pytest.mark.parametrize(
    "how",
    [
        "refused",
        "crushed",
        "endless",
        "nan",
    ],
)
@pytest.mark.slow
def test_where_it_fails_newton_steps_the_load_from_rest(ventricle, monkeypatch, how):
    simulator, theta = em.Simulator(ventricle), ventricle.centre
    expected = simulator(theta)
    step, begun = StressIterates.step, []

    def fail(self, state, load_stiffness, geometric, again):
        after = step(self, state, load_stiffness, geometric, again)
        begun.append(float(self.load))
        if how == "crushed":
            return after._replace(fraction=jnp.array(0.0))
        if how == "refused":
            return after._replace(definite=jnp.array(False))
        return after._replace(error=jnp.array(jnp.nan if how == "nan" else 0.9))

    monkeypatch.setattr(StressIterates, "step", fail)
    solution = by_python(simulator, theta)
    assert solution.converged
    assert {0.02, 0.05, 0.25, 0.5} <= set(begun)  # every schedule
    np.testing.assert_allclose(solution.displacement, expected, atol=1e-8)


def test_whom_it_is_for(beam, traction_beam):
    """Exponential laws: for others Newton's method is as quick, and is compiled anyway."""
    mu = (em.Parameter("mu", "kPa", 1.0, 10.0),)
    energy = lambda strain, mu: mu * jnp.expm1(jnp.sum(strain.H**2))
    of_gradient = Law("of H", (modulus("mu"),), energy, exponential=True)
    assert applies(traction_beam)
    assert not applies(replace(block(), law=of_gradient, parameters=mu))
    assert not applies(beam)


def test_a_good_start_keeps_its_load_and_a_poor_one_is_left(ventricle, monkeypatch):
    simulator, theta = em.Simulator(ventricle), ventricle.centre
    u = simulator(theta)
    step, levels = StressIterates.step, []

    def noting(self, state, load_stiffness, geometric, again):
        levels.append(float(self.load))
        return step(self, state, load_stiffness, geometric, again)

    monkeypatch.setattr(StressIterates, "step", noting)
    errors = {k: float(simulator.system.relative_residual(k * u, theta)) for k in (0.8, 0.01)}
    assert 0.05 < errors[0.8] < 0.9 < errors[0.01]
    good, poor = (by_python(simulator, theta, k * u) for k in (0.8, 0.01))
    assert levels[0] == 1.0
    assert 0.5 in levels  # from rest
    for solution in (good, poor):
        np.testing.assert_allclose(solution.displacement, u, atol=1e-8)


@pytest.fixture(scope="module")
def dilated():
    return replace(em.scenes.left_ventricle(3, 8, 1), dilatation="mean", origin={})


@pytest.mark.slow
def test_with_mean_dilatation_they_converge_quadratically(dilated):
    """The law sees each element's mean volume ratio; so do the measures and their tangent."""
    scene, theta = dilated, dilated.from_unit(jnp.array([1.0, 1.0, 1.0, 1.0, 0.0]))
    own, errors = mip(scene, theta), []
    state, step = own.begin(jnp.zeros(scene.held.shape)), jax.jit(own.step)
    for iteration in range(8):
        state = step(state, jnp.array(float(iteration > 0)))
        errors.append(float(state.error))
    assert errors[-1] < 1e-10
    last = [error for error in errors if 1e-9 < error < 0.1]
    assert all(after < 10.0 * before**1.6 for before, after in pairwise(last))


@pytest.mark.slow
@pytest.mark.optimised
def test_with_mean_dilatation_they_end_where_newton_does(dilated):
    scene = dilated
    ramps, volumes = (
        em.Simulator(scene, NewtonOptions(stress_iterates=used)).solve(scene.centre)
        for used in (True, False)
    )
    np.testing.assert_allclose(ramps.displacement, volumes.displacement, atol=1e-8)
    assert int(ramps.iterations) <= 0.6 * int(volumes.iterations)  # 10 and 22


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_body_that_is_pulled_by_its_face_climbs_the_ramps(order):
    """Prescribed displacements: fewer than Newton's iterations, the same end."""
    mesh = box((10.0, 10.0, 10.0), (2, 2, 2), order)
    scene = Scene(
        name="pulled",
        mesh=mesh,
        law=find_law("holzapfel_ogden"),
        parameters=MYOCARDIUM,
        supports=(Support("left"), Support("right", displacement=(2.0, 3.0, 0.0))),
        constants={"kappa": 25.0},
        fibres=np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1)),
    )
    theta = scene.from_unit(jnp.array([0.0, 1.0, 0.0, 1.0]))
    with_ramps, without = (
        em.Simulator(scene, NewtonOptions(stress_iterates=used)).solve(theta)
        for used in (True, False)
    )
    assert with_ramps.converged
    assert without.converged
    np.testing.assert_allclose(with_ramps.displacement, without.displacement, atol=1e-8)
    assert int(with_ramps.iterations) <= 0.8 * int(without.iterations)
    compiled = jax.jit(em.Simulator(scene).solve)(theta)
    assert int(compiled.iterations) == int(with_ramps.iterations)
