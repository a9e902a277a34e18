"""Supports whose displacement is a parameter, and the forces they take."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.campaign import Runs
from emulator.fem.reactions import SupportForce
from emulator.geometry.generators.box import box
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.finer import finer
from emulator.surrogates.pod_gp import fit_reduced
from emulator.surrogates.taylor import expand
from scene_support import HEIGHT, between_plates


@pytest.fixture(scope="module")
def simulator():
    return em.Simulator(between_plates())


THETA = jnp.array([3.0, 0.3, -0.1])


def test_plates_are_where_theta_puts_them(simulator):
    scene = simulator.scene
    u = simulator(THETA)
    top = scene.mesh.node_set("top")
    np.testing.assert_allclose(u[top], [[0.3 * HEIGHT, 0.0, -0.1 * HEIGHT]] * len(top), rtol=1e-14)
    np.testing.assert_array_equal(u[scene.mesh.node_set("bottom")], 0.0)
    assert scene.load_parameters == ("shear", "stretch")


@pytest.mark.slow
def test_it_is_the_scene_with_that_displacement_prescribed(simulator):
    """Solved by another description: numbers in place of amounts."""
    moved = (0.3 * HEIGHT, 0.0, -0.1 * HEIGHT)
    fixed = replace(
        between_plates(),
        parameters=between_plates().parameters[:1],
        supports=(Support("bottom"), Support("top", moved)),
    )
    np.testing.assert_allclose(simulator(THETA), em.Simulator(fixed)(THETA[:1]), atol=1e-10)


def test_no_way_to_go_is_rest(simulator):
    found = simulator.solve(jnp.array([3.0, 0.0, 0.0]))
    assert found.converged
    np.testing.assert_array_equal(found.displacement, 0.0)


def central(function, theta, k, h=1e-5):
    step = jnp.zeros_like(theta).at[k].set(h)
    return (function(theta + step) - function(theta - step)) / (2.0 * h)


@pytest.mark.parametrize("k", [0, 1, 2])
def test_derivatives_are_central_differences(simulator, k):
    u = simulator(THETA)
    expected = central(simulator, THETA, k)
    np.testing.assert_allclose(simulator.sensitivities(u, THETA)[k], expected, atol=1e-7)
    along = jnp.zeros(3).at[k].set(1.0)
    by_jvp = jax.jvp(simulator, (THETA,), (along,))[1]
    np.testing.assert_allclose(by_jvp, expected, atol=1e-7)


@pytest.mark.slow
def test_reverse_derivatives_are_forward_ones(simulator):
    weight = jnp.asarray(np.random.default_rng(0).normal(size=simulator.scene.held.shape))
    back = jax.grad(lambda t: jnp.vdot(weight, simulator(t)))(THETA)
    forward = jnp.tensordot(simulator.sensitivities(simulator(THETA), THETA), weight, axes=2)
    np.testing.assert_allclose(back, forward, rtol=1e-8)


@pytest.mark.slow
def test_a_series_follows_the_plates_exactly(simulator):
    scene = simulator.scene
    series = expand(simulator, scene.theta(mu=3.0, shear=0.2, stretch=0.05), order=3)
    near = scene.theta(mu=3.3, shear=0.25, stretch=0.03)
    found = series(scene.to_unit(near))
    np.testing.assert_allclose(found[scene.held], simulator(near)[scene.held], atol=1e-12)
    np.testing.assert_allclose(found, simulator(near), atol=2e-5)


def test_an_emulators_plates_are_exact(simulator):
    scene = simulator.scene
    emulator = em.Emulator(scene, taylor=expand(simulator, order=1))
    theta = jnp.stack([THETA, THETA.at[1].set(-0.4)])
    cached = emulator.cache(scene.mesh.node_set("top"))(theta)
    np.testing.assert_allclose(cached[:, 0, 0], [0.3 * HEIGHT, -0.4 * HEIGHT], rtol=1e-14)
    np.testing.assert_allclose(emulator(THETA)[scene.mesh.node_set("top")], cached[0], rtol=1e-14)


def test_a_reduced_models_plates_are_exact(simulator):
    thetas = curve(simulator, 4)
    u = simulator.path(thetas).displacement
    reduced = fit_reduced(simulator.scene, Runs(thetas, u, jnp.zeros(4)))
    top = simulator.scene.mesh.node_set("top")
    found = reduced.at(top)(THETA.at[1].set(0.21))
    np.testing.assert_allclose(found[:, 0], 0.21 * HEIGHT, rtol=1e-14)


def curve(simulator, count=6):
    return jnp.stack([THETA.at[1].set(k) for k in jnp.linspace(0.0, 0.45, count)])


def test_a_path_is_its_points(simulator):
    thetas = curve(simulator)
    found = simulator.path(thetas)
    assert found.converged.all()
    for k, theta in enumerate(thetas):
        np.testing.assert_allclose(found.displacement[k], simulator(theta), atol=1e-9)
    cold = [int(simulator.solve(theta).iterations) for theta in thetas]
    assert int(found.iterations[2:].sum()) < sum(cold[2:])


@pytest.mark.slow
def test_a_curve_of_forces_is_differentiable(simulator):
    force = SupportForce(simulator.scene, "top", (1.0, 0.0, 0.0))

    def forces(mu):
        thetas = curve(simulator, 4).at[:, 0].set(mu)
        u = simulator.path(thetas).displacement
        return force(u[:, force.nodes], thetas)

    slope = jax.jvp(forces, (jnp.asarray(3.0),), (jnp.asarray(1.0),))[1]
    by_differences = (forces(3.001) - forces(2.999)) / 0.002
    np.testing.assert_allclose(slope[1:], by_differences[1:], rtol=1e-6)


@pytest.mark.slow
def test_a_path_leaves_rest_as_a_solve_does(simulator):
    """Supports that jump, alone, are no start: a path's first point is a cold solve."""
    thetas = curve(simulator)[2:4]
    found = simulator.path(thetas)
    assert int(found.iterations[0]) == int(simulator.solve(thetas[0]).iterations)
    traced = jax.jit(simulator.path)(thetas)
    np.testing.assert_allclose(traced.displacement, found.displacement, atol=1e-12)


def test_a_forces_gradient_is_that_of_its_solve(simulator):
    """By one adjoint solve, where theta moves the support, too."""
    force = SupportForce(simulator.scene, "top", (1.0, 0.0, 0.0))

    def of(u, theta):
        return force(u[force.nodes], theta)

    u = simulator(THETA)
    value, gradient = simulator.gradient_of(of)(u, THETA)
    assert float(value) == pytest.approx(float(of(u, THETA)), rel=1e-14)
    expected = jax.grad(lambda theta: of(simulator(theta), theta))(THETA)
    np.testing.assert_allclose(gradient, expected, rtol=1e-10, atol=1e-12)
    along = jnp.tensordot(simulator.sensitivities(u, THETA), jax.grad(of)(u, THETA), 2)
    np.testing.assert_allclose(gradient, along + jax.grad(of, 1)(u, THETA), rtol=1e-10, atol=1e-12)


def test_a_path_that_is_none(simulator):
    with pytest.raises(InputError, match=r"path has shape \(3,\); expected \(m, 3\)"):
        simulator.path(THETA)


def least_energy(simulator):
    def energy(theta):
        u = simulator(theta)
        return simulator.system.potential(u, theta)[0]

    return energy


@pytest.mark.parametrize("dilatation", ["pointwise", pytest.param("mean", marks=pytest.mark.slow)])
def test_forces_are_derivatives_of_the_least_energy(dilatation):
    """By the plate's own displacement: 4 mm a unit of either amount."""
    simulator = em.Simulator(between_plates(dilatation=dilatation))
    u = simulator(THETA)
    for k, direction in ((1, (1.0, 0.0, 0.0)), (2, (0.0, 0.0, 1.0))):
        force = SupportForce(simulator.scene, "top", direction)
        found = force(u[force.nodes], THETA)
        work = jax.grad(least_energy(simulator))(THETA)[k]
        assert found == pytest.approx(float(work) / HEIGHT, rel=1e-9)
        by_differences = central(least_energy(simulator), THETA, k, 1e-4)
        assert found == pytest.approx(float(by_differences) / HEIGHT, rel=1e-6)
        below = SupportForce(simulator.scene, "bottom", direction)
        assert below(u[below.nodes], THETA) == pytest.approx(-float(found), rel=1e-8)


@pytest.mark.slow
def test_patches_of_linear_elements_have_forces():
    simulator = em.Simulator(between_plates(order=1, dilatation="patch", cells=(3, 3, 3)))
    u = simulator(THETA)
    force = SupportForce(simulator.scene, "top", (1.0, 0.0, 0.0))
    whole = simulator.reaction("top", u, THETA)[0]
    assert force(u[force.nodes], THETA) == pytest.approx(float(whole), rel=1e-10)
    work = jax.grad(least_energy(simulator))(THETA)[1]
    assert force(u[force.nodes], THETA) == pytest.approx(float(work) / HEIGHT, rel=1e-8)


def sliding(law, parameters, constants, supports):
    return Scene(
        name="block on sliding plates",
        mesh=box((4.0, 4.0, HEIGHT), (1, 1, 1), 2),
        law=find_law(law),
        parameters=parameters,
        constants=constants,
        supports=supports,
    )


@pytest.mark.slow
def test_a_stretch_with_sliding_plates_in_closed_form():
    """Uniaxial: lateral stretch of zero stress by bisection, force by the law's own derivative."""
    supports = (
        Support("left", components="x"),
        Support("front", components="y"),
        Support("bottom", components="z"),
        Support("top", (0.0, 0.0, HEIGHT), "z", amount="stretch"),
    )
    moduli, stretch = {"mu": 3.0, "lam": 8.0}, 0.25
    scene = sliding("neo_hookean", (Parameter("stretch", "", 0.0, 0.5),), moduli, supports)
    simulator, theta = em.Simulator(scene), jnp.array([stretch])
    u = simulator(theta)
    law = find_law("neo_hookean")

    def energy(across, along):
        H = jnp.diag(jnp.stack([across, across, along])) - jnp.eye(3)
        return law.energy(Strain(H, None, None), *(moduli[n] for n in law.parameters))

    low, high = 0.5, 1.2
    for _ in range(100):
        middle = 0.5 * (low + high)
        if jax.grad(energy)(jnp.asarray(middle), jnp.asarray(1.0 + stretch)) > 0.0:
            high = middle
        else:
            low = middle
    P = jax.grad(energy, argnums=1)(jnp.asarray(low), jnp.asarray(1.0 + stretch))
    force = SupportForce(scene, "top", (0.0, 0.0, 1.0))
    assert force(u[force.nodes], theta) == pytest.approx(float(P) * 16.0, rel=1e-10)


@pytest.mark.slow
def test_a_shear_with_the_sides_led_in_closed_form():
    """Simple shear of the whole boundary: F = I + k e_x e_z, force P_xz times the face."""
    mesh = box((4.0, 4.0, HEIGHT), (2, 2, 2), 2)
    faces = ("left", "right", "front", "back", "bottom", "top")
    boundary = np.unique(np.concatenate([mesh.node_set(name) for name in faces]))
    mesh = replace(mesh, node_sets={**mesh.node_sets, "boundary": boundary})
    led = np.zeros((len(boundary), 3))
    led[:, 0] = mesh.nodes[boundary, 2]
    scene = Scene(
        name="led block",
        mesh=mesh,
        law=find_law("neo_hookean"),
        parameters=(Parameter("mu", "kPa", 1.0, 10.0), Parameter("shear", "", -1.0, 1.0)),
        constants={"lam": 8.0},
        supports=(Support("boundary", led, amount="shear"),),
    )
    simulator, theta = em.Simulator(scene), jnp.array([3.0, 0.7])
    u = simulator(theta)
    np.testing.assert_allclose(u[:, 0], 0.7 * mesh.nodes[:, 2], atol=1e-12)
    # P = mu (F - F^-T) + lam ln J F^-T with J = 1: P_xz = mu k. All of it acts on all faces, and
    # what plates at the top take of the boundary's is found by the derivative of the energy.
    work = jax.grad(least_energy(simulator))(theta)[1]
    assert float(work) == pytest.approx(3.0 * 0.7 * 64.0, rel=1e-10)
    fine = finer(scene).scene
    again = em.Simulator(fine)(theta)
    np.testing.assert_allclose(again[:, 0], 0.7 * fine.mesh.nodes[:, 2], atol=1e-12)


def test_moved_supports_are_part_of_what_a_scene_is():
    scene = between_plates()
    other = between_plates(
        supports=(
            *scene.supports[:1],
            Support("top", (2.0, 0.0, 0.0), "x", amount="shear"),
            *scene.supports[2:],
        )
    )
    assert scene.fingerprint != other.fingerprint
    assert not scene.identity.agrees(other.identity)


@pytest.mark.parametrize(
    ("supports", "said"),
    [
        (
            (Support("bottom"), Support("top", (1.0, 0.0, 0.0), amount="shear"), Support("top")),
            "contradicts another one at node .*: x is 1 mm times shear there, not 0",
        ),
        ((Support("bottom"),), "parameter 'shear' is not one of law"),
        ((Support("bottom"), Support("top", (1, 0, 0), amount="mu")), "both have a parameter 'mu'"),
    ],
)
def test_supports_that_cannot_be(supports, said):
    with pytest.raises(InputError, match=said):
        between_plates(supports=supports, parameters=between_plates().parameters[:2])


@pytest.mark.parametrize(
    ("name", "direction", "said"),
    [
        ("side", (1.0, 0.0, 0.0), "has no support on 'side'; it has bottom, top"),
        ("top", (0.0, 0.0, 0.0), "direction"),
        ("left", (1.0, 0.0, 0.0), "no support on 'left'"),
    ],
)
def test_forces_of_what_holds_nothing(name, direction, said):
    with pytest.raises(InputError, match=said):
        SupportForce(between_plates(), name, direction)
