"""Active tension, against its energy written with invariants and against a block by hand."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.energy import (
    local_terms,
    potential_energy,
    strain_energy,
)
from emulator.fem.fields import element_fields
from emulator.fem.newton import NewtonOptions
from emulator.fem.reactions import SupportForce
from emulator.geometry.generators.box import box
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.effects import leave_out
from emulator.scenes.loads import ActiveTension, Gravity
from scene_support import between_plates, block

TENSION = Parameter("tension", "kPa", 0.0, 100.0)


def muscle(transverse=0.0, dilatation="pointwise") -> Scene:
    """A quadratic block whose fibre turns from point to point; theta = (mu, tension)."""
    mesh = box((2.0, 3.0, 4.0), (1, 2, 2), order=2)
    fibres = np.random.default_rng(3).normal(size=(len(mesh.elements), 4, 3))
    return Scene(
        name="muscle",
        mesh=mesh,
        law=find_law("neo_hookean"),
        parameters=(Parameter("mu", "kPa", 1.0, 10.0), TENSION),
        constants={"lam": 20.0},
        loads=(ActiveTension(transverse=transverse),),
        supports=(Support("left"),),
        fibres=fibres / np.linalg.norm(fibres, axis=-1, keepdims=True),
        dilatation=dilatation,
    )


def by_invariants(scene, u, tension, transverse):
    """The integral of T/2 [(I4f - 1) + eta (I4s + I4n - 2)], mN mm."""
    F = scene.gradients(u) + jnp.eye(3)
    I1 = jnp.einsum("mqij,mqij->mq", F, F)
    C = jnp.einsum("mqki,mqkj->mqij", F, F)
    I4f = jnp.einsum("mqi,mqij,mqj->mq", scene.fibres, C, scene.fibres)
    density = 0.5 * tension * ((I4f - 1.0) + transverse * (I1 - I4f - 2.0))
    return jnp.sum(scene.discretisation.weights * density)


@pytest.mark.parametrize("transverse", [0.0, 0.3])
def test_energy_force_and_tangent_are_those_of_the_invariants(transverse):
    scene = muscle(transverse)
    u = 0.2 * jax.random.normal(jax.random.key(1), scene.held.shape)
    values, (term,) = scene.resolve(jnp.array([2.0, 7.0])), local_terms(scene)
    energy = lambda v: by_invariants(scene, v, 7.0, transverse)
    np.testing.assert_allclose(term.total(u, values), energy(u), rtol=1e-12)
    force = jax.grad(energy)(u)
    np.testing.assert_allclose(jax.grad(term.total)(u, values), force, atol=1e-11)
    np.testing.assert_allclose(
        System(scene).external_force(u, jnp.array([2.0, 7.0])), -force, atol=1e-11
    )
    # The force of fibres on each other has no resultant.
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-11)


@pytest.mark.parametrize("transverse", [0.0, 0.3])
def test_the_tangent_is_the_force_s_slope_and_convex(transverse):
    scene, theta = muscle(transverse), jnp.array([2.0, 7.0])
    system = System(scene)
    u, along = 0.1 * jax.random.normal(jax.random.key(2), (2, *scene.held.shape))
    along = jnp.where(scene.held, 0.0, along)
    K = system.tangent(u, theta) - system.tangent(u, theta.at[1].set(0.0))
    found = system.pattern.product(K, system.restrict(along))
    external = lambda v: system.restrict(-system.external_force(v, theta))
    h = 1e-3  # the force is linear
    slope = (external(u + h * along) - external(u - h * along)) / (2.0 * h)
    np.testing.assert_allclose(found, slope, atol=1e-9)
    assert jnp.vdot(found, system.restrict(along)) > 0.0


def sliding(law, transverse, **changes) -> Scene:
    """An eighth of a block whose fibres are along x, on planes of symmetry."""
    mesh = box((2.0, 3.0, 4.0), (2, 1, 1), order=2)
    supports = (("left", "x"), ("front", "y"), ("bottom", "z"))
    return Scene(
        name="strip",
        mesh=mesh,
        law=find_law(law),
        parameters=(Parameter("mu", "kPa", 1.0, 10.0), TENSION),
        loads=(ActiveTension(transverse=transverse),),
        supports=tuple(Support(name, components=axis) for name, axis in supports),
        fibres=np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1)),
        **changes,
    )


@pytest.mark.parametrize("J", [pytest.param(0.97, marks=pytest.mark.slow), 0.9])
@pytest.mark.parametrize("dilatation", ["pointwise", pytest.param("mean", marks=pytest.mark.slow)])
def test_a_strip_shortens_as_it_does_by_hand(J, dilatation):
    r"""With :math:`W = \mu/2 (I_1 - 3) - \mu \ln J + \lambda/2 (\ln J)^2` nothing pulls at the ends,

    so that :math:`(\mu + T) \lambda_f^2 = \mu \lambda_t^2 = \mu - \lambda \ln J = m`, and with
    :math:`J = \lambda_f \lambda_t^2` the tension is :math:`m^3 / (J \mu)^2 - \mu`.
    """
    mu, lam = 3.0, 20.0
    m = mu - lam * np.log(J)
    tension = m**3 / (J * mu) ** 2 - mu
    scene = sliding("neo_hookean", 0.0, constants={"lam": lam}, dilatation=dilatation)
    theta = jnp.array([mu, tension])
    u = em.Simulator(scene).solve(theta).require_converged().displacement
    stretch = np.sqrt([m / (mu + tension), m / mu, m / mu])
    np.testing.assert_allclose(u, (stretch - 1.0) * scene.mesh.nodes, atol=1e-10)
    # Passive and active stress balance: nothing presses on the ends.
    stress = element_fields(scene, u, theta)["cauchy_stress"]
    np.testing.assert_allclose(stress, 0.0, atol=1e-9)


def test_tension_in_every_direction_alike_takes_the_volume_alone():
    """eta = 1 is a stress T F F^T / J, which a cube answers with one stretch."""
    scene = sliding("neo_hookean", 1.0, constants={"lam": 20.0})
    theta = jnp.array([3.0, 5.0])
    u = em.Simulator(scene)(theta)
    stretch = 1.0 + u[:, 0].min() / 2.0
    np.testing.assert_allclose(u, (stretch - 1.0) * scene.mesh.nodes, atol=1e-10)
    np.testing.assert_allclose((3.0 + 5.0) * stretch**2, 3.0 - 60.0 * np.log(stretch), rtol=1e-10)


@pytest.mark.slow
def test_supports_hold_what_the_tissue_pulls():
    """A strip of 2 mm glued at both ends: the supports' work on stretching it is the energy's."""
    scene = sliding("neo_hookean", 0.0, constants={"lam": 20.0})
    scene = replace(scene, supports=(*scene.supports, Support("right")))
    simulator, theta = em.Simulator(scene), jnp.array([3.0, 5.0])
    u = simulator(theta)
    left, right = (simulator.reaction(name, u, theta)[0] for name in ("left", "right"))
    wider = replace(scene, fibres=scene.fibres_at_points)
    energy = lambda v: strain_energy(scene)(v, theta) + by_invariants(wider, v, 5.0, 0.0)
    stretching = jnp.zeros_like(u).at[:, 0].set(scene.mesh.nodes[:, 0])
    np.testing.assert_allclose(2.0 * right, jax.jvp(energy, (u,), (stretching,))[1], rtol=1e-8)
    np.testing.assert_allclose(left, -right, rtol=1e-8)
    near = SupportForce(scene, "right", (1.0, 0.0, 0.0))
    np.testing.assert_allclose(near(u[near.nodes], theta), right, rtol=1e-10)


def test_without_tension_it_is_the_passive_body_and_passive_bodies_pay_nothing():
    scene = muscle()
    u = 0.1 * jax.random.normal(jax.random.key(4), scene.held.shape)
    passive = leave_out(replace(scene, loads=(*scene.loads, Gravity())), ("active tension",))
    assert passive.fibres is None
    assert passive.parameter_names == ("mu",)
    assert scene.tissue_at(jnp.array([2.0, 5.0])).directions is None  # the law reads none
    slack = replace(scene, loads=(ActiveTension(0.0), Gravity()), parameters=scene.parameters[:1])
    np.testing.assert_allclose(
        potential_energy(slack)(u, jnp.array([2.0])),
        potential_energy(passive)(u, jnp.array([2.0])),
        rtol=1e-14,
    )
    assert System(passive).terms == []


@pytest.mark.slow
def test_contraction_between_plates_that_move():
    """Both prescribed displacements and tension: equilibrium, and derivatives by differences."""
    scene = between_plates()
    count = len(scene.mesh.elements)
    scene = replace(
        scene,
        parameters=(*scene.parameters, TENSION),
        loads=(ActiveTension(),),
        fibres=np.tile([0.0, 0.6, 0.8], (count, 1)),
    )
    assert scene.load_parameters == ("shear", "stretch", "tension")
    simulator, theta = em.Simulator(scene), jnp.array([3.0, 0.3, 0.1, 8.0])
    u = simulator.solve(theta).require_converged().displacement
    h = 1e-4
    ahead, behind = (simulator(theta.at[3].add(s)) for s in (h, -h))
    np.testing.assert_allclose(
        simulator.sensitivities(u, theta)[3], (ahead - behind) / (2 * h), atol=1e-7
    )


def contracting(mesh=(3, 8, 1), kappa=200.0) -> Scene:
    """A ventricle under tension; theta = (a, b, a_f, b_f, pressure, tension)."""
    base = em.scenes.left_ventricle(*mesh, kappa=kappa)
    box = (Parameter("pressure", "kPa", 0.1, 20.0), TENSION)
    return replace(
        base,
        parameters=(*base.parameters[:-1], *box),
        loads=(*base.loads, ActiveTension()),
        dilatation="mean",
        origin={},
    )


@pytest.mark.slow
@pytest.mark.parametrize(("pressure", "tension"), [(1.0, 20.0), (12.0, 60.0), (16.0, 100.0)])
def test_ventricles_contract_along_the_path_that_small_steps_take(pressure, tension):
    scene = contracting()
    theta = scene.centre.at[4].set(pressure).at[5].set(tension)
    found = em.Simulator(scene).solve(theta).require_converged()
    small = NewtonOptions(increment=0.05, stress_iterates=False)
    followed = em.Simulator(scene, small).solve(theta).require_converged()
    np.testing.assert_allclose(found.displacement, followed.displacement, atol=1e-6)


def test_no_fibres_and_values_that_cannot_be():
    with pytest.raises(InputError, match="load 'active_tension' needs fibres"):
        block(loads=(ActiveTension(5.0),))
    with pytest.raises(InputError, match="tension is -1.0 kPa; it must be 0 or more"):
        ActiveTension(-1.0)
    with pytest.raises(InputError, match="transverse is 1.5; it is a share between 0 and 1"):
        ActiveTension(transverse=1.5)
    below = replace(TENSION, low=-1.0)
    with pytest.raises(InputError, match="'tension' ranges down to -1 kPa; it must not go below 0"):
        replace(muscle(), parameters=(muscle().parameters[0], below))
    fixed = {**muscle().constants, "tension": -1.0}
    with pytest.raises(InputError, match="'tension' is -1 kPa; it must be 0 or more"):
        replace(muscle(), parameters=muscle().parameters[:1], constants=fixed)
