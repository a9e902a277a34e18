from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.energy import local_forces, potential_energy
from emulator.geometry.facets import enclosed_volume, rim
from emulator.geometry.refinement import to_quadratic
from emulator.mechanics.kinematics import cofactor
from emulator.scenes import Parameter, Support
from emulator.scenes.loads import CavityPressure, FollowerPressure, PublishedPressure
from scene_support import block, rotation

VOLUME = 24.0  # of the block, mm3


def closed():
    """The block, its whole surface one facet set: a body in a pressurised bath."""
    scene = block(cells=(3, 2, 2))
    surface = np.concatenate(list(scene.mesh.facet_sets.values()))
    return replace(scene, mesh=replace(scene.mesh, facet_sets={"surface": surface}))


def membrane(load):
    """The block with a pressure on its right face, whose rim is held."""
    scene = block(cells=(2, 4, 4))
    edge = np.unique(rim(scene.mesh.facet_set("right")))
    mesh = replace(scene.mesh, node_sets={**scene.mesh.node_sets, "rim": edge})
    return replace(scene, mesh=mesh, loads=(load,), supports=(Support("left"), Support("rim")))


def volume_behind(scene, facet_set):
    """``u -> V`` in mL on the side of the facets away from the tissue, lids included."""
    outward, X = enclosed_volume(scene.mesh.facet_set(facet_set)), jnp.asarray(scene.mesh.nodes)
    return lambda u: -outward(X + u) / 1000.0


def test_cofactor():
    F = np.eye(3) + 0.3 * np.random.default_rng(0).normal(size=(3, 3))
    np.testing.assert_allclose(
        cofactor(jnp.asarray(F)), np.linalg.det(F) * np.linalg.inv(F).T, atol=1e-13
    )


def test_volume_of_a_closed_surface():
    scene = closed()
    V = volume_behind(scene, "surface")
    # The cavity lies outside the tissue: the body's own volume counts negative. 1 mL = 1000 mm3.
    assert V(jnp.zeros(scene.held.shape)) == pytest.approx(-VOLUME / 1000.0)
    H = 0.2 * np.random.default_rng(0).normal(size=(3, 3))
    moved = jnp.asarray(scene.mesh.nodes @ H.T + [7.0, -2.0, 1.0])
    expected = -VOLUME / 1000.0 * np.linalg.det(np.eye(3) + H)
    assert V(moved) == pytest.approx(expected, rel=1e-12)


def test_pressure_on_a_closed_surface_has_no_net_force_or_moment():
    scene = closed()
    (term,) = CavityPressure("surface", 2.0).terms(scene.discretisation)
    u = jnp.asarray(0.1 * np.random.default_rng(1).normal(size=scene.held.shape))
    force = -jax.grad(lambda v: term.total(v, {}))(u)
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(scene.mesh.nodes + u, force).sum(axis=0), 0.0, atol=1e-11)
    # In a bath the body is squeezed: work is pressure times the volume given up.
    squeezed = jnp.asarray(-0.1 * scene.mesh.nodes)
    assert term.total(squeezed, {}) == pytest.approx(2.0 * VOLUME * (0.9**3 - 1.0))


def test_the_energy_is_minus_p_times_the_change_in_volume():
    scene = membrane(CavityPressure("right", 0.7))
    (term,), V = scene.loads[0].terms(scene.discretisation), volume_behind(scene, "right")
    u = jnp.where(scene.held, 0.0, 0.1)
    change = 1000.0 * (V(u) - V(jnp.zeros_like(u)))
    assert term.total(u, {}) == pytest.approx(-0.7 * float(change), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [CavityPressure, PublishedPressure])
def test_a_pressed_face_gives_way_and_the_tangent_is_right(kind):
    scene = membrane(kind("right", 0.5))
    simulator = em.Simulator(scene)
    solution = simulator.solve(scene.centre)
    assert solution.converged
    V = volume_behind(scene, "right")
    assert V(solution.displacement) > V(jnp.zeros(scene.held.shape))  # the cavity grows
    system, theta, u = simulator.system, scene.centre, solution.displacement
    direction = jnp.asarray(np.random.default_rng(1).normal(size=len(system.free)))
    product = jax.jvp(lambda v: system.residual(v, theta), (u,), (system.extend(direction),))[1]
    told = system.pattern.product(system.tangent(u, theta), direction)
    np.testing.assert_allclose(told, product, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_pressure_as_a_parameter():
    scene = membrane(CavityPressure("right", 0.5))
    free = replace(
        scene,
        loads=(CavityPressure("right"),),
        parameters=(*scene.parameters, Parameter("pressure", "kPa", 0.1, 1.0)),
    )
    theta = free.theta(mu=3.0, lam=5.0, pressure=0.5)
    simulator = em.Simulator(free)
    np.testing.assert_allclose(simulator(theta), em.Simulator(scene)(theta[:2]), atol=1e-9)
    V = volume_behind(free, "right")
    f = lambda t: V(simulator.solve(t).displacement)
    h = 1e-4
    central = (f(theta.at[2].add(h)) - f(theta.at[2].add(-h))) / (2 * h)
    assert jax.grad(f)(theta)[2] == pytest.approx(float(central), rel=1e-6)
    with pytest.raises(InputError, match="load CavityPressure needs 'pressure'"):
        replace(free, parameters=scene.parameters)


def test_a_cavity_whose_rim_is_loose_is_refused():
    with pytest.raises(InputError, match=r"cavity 'right': rim node \d+ .* hold the rim or use"):
        replace(block(), loads=(CavityPressure("right", 1.0),))


def test_a_scene_without_pressure_computes_no_facets():
    def operations(scene):
        jaxpr = jax.make_jaxpr(em.fem.potential_energy(scene))(
            jnp.zeros(scene.held.shape), scene.centre
        )
        return len(jaxpr.jaxpr.eqns)

    with_pressure = membrane(CavityPressure("right", 0.5))
    without = replace(with_pressure, loads=())
    assert operations(without) == operations(block())
    assert operations(with_pressure) > operations(without)


def test_fibres_are_asked_for_only_by_laws_that_use_them():
    from emulator.mechanics.laws import find_law

    scene = block()
    count = len(scene.mesh.elements)
    fibres = np.tile([1.0, 0.0, 0.0], (count, 1))
    with pytest.raises(InputError, match="law 'neo_hookean' takes no fibres"):
        replace(scene, fibres=fibres)
    law = find_law("guccione")
    parameters = tuple(Parameter(q.name, q.unit, 1.0, 2.0) for q in law.quantities)
    other = {"law": law, "parameters": parameters}
    with pytest.raises(InputError, match="law 'guccione' needs fibres"):
        replace(scene, **other)
    with pytest.raises(InputError, match=r"fibres have shape \(1, 3\)"):
        replace(scene, **other, fibres=fibres[:1])
    with pytest.raises(InputError, match="fibres are not unit vectors"):
        replace(scene, **other, fibres=2.0 * fibres)
    a = replace(scene, **other, fibres=fibres)
    b = replace(scene, **other, fibres=np.roll(fibres, 1, axis=1))
    assert a.fingerprint != b.fingerprint
    # Stiffer along the fibres: the same stretch costs more.
    u = jnp.asarray(scene.mesh.nodes * [0.1, 0.0, 0.0])
    theta = jnp.array([1.0, 2.0, 1.0, 1.0, 1.0])
    assert em.fem.potential_energy(a)(u, theta) > em.fem.potential_energy(b)(u, theta)


def pressed(order=1, pressure=2.0):
    scene = block(loads=(FollowerPressure("right", pressure),), cells=(2, 1, 1))
    return scene if order == 1 else replace(scene, mesh=to_quadratic(scene.mesh))


@pytest.mark.parametrize("order", [1, 2])
def test_following_force_is_pressure_times_area_and_turns_with_the_patch(order):
    scene = pressed(order)
    (term,) = local_forces(scene)
    # The right face is 3 x 4 mm, its outward normal x: 2 kPa push with 24 mN along -x.
    force = term.total(jnp.zeros(scene.held.shape), {}).sum(axis=0)
    np.testing.assert_allclose(force, [-24.0, 0.0, 0.0], atol=1e-12)
    R = rotation()
    turned = jnp.asarray(scene.mesh.nodes @ (R - np.eye(3)).T)
    np.testing.assert_allclose(term.total(turned, {}).sum(axis=0), R @ force, atol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_following_tangent_is_the_derivative_of_the_force_and_not_symmetric(order):
    scene = pressed(order)
    (term,) = local_forces(scene)
    u = jnp.asarray(0.1 * np.random.default_rng(0).normal(size=scene.held.shape))
    v = jnp.asarray(np.random.default_rng(1).normal(size=scene.held.shape))
    _, change = jax.jvp(lambda w: term.total(w, {}), (u,), (v,))
    blocks = term.tangents(u, {})
    local = jnp.einsum("kij,kj->ki", blocks, v[term.nodes].reshape(len(term.nodes), -1))
    summed = jnp.zeros_like(u).at[term.nodes].add(local.reshape(*term.nodes.shape, 3))
    np.testing.assert_allclose(-summed, change, atol=1e-12)
    assert not np.allclose(blocks, blocks.transpose(0, 2, 1))


@pytest.mark.slow
def test_a_follower_is_equal_to_the_cavity_where_the_rim_is_held():
    # The top face of a block held all round: its rim is held, so -p V is exact too.
    sides = tuple(em.Support(name) for name in ("left", "right", "front", "back"))
    follower = block(loads=(FollowerPressure("top", 0.5),), supports=sides, cells=(3, 3, 2))
    cavity = replace(follower, loads=(CavityPressure("top", 0.5),))
    theta = follower.centre
    one, other = em.Simulator(follower)(theta), em.Simulator(cavity)(theta)
    assert float(jnp.abs(one).max()) > 0.01
    np.testing.assert_allclose(one, other, atol=1e-10)


@pytest.mark.slow
def test_derivative_in_theta_through_the_unsymmetric_tangent():
    scene = pressed(pressure=0.3)
    simulator = em.Simulator(scene)
    theta = scene.centre
    f = lambda t: jnp.sum(simulator.solve(t).displacement ** 2)
    h = 1e-4
    central = [(f(theta.at[k].add(h)) - f(theta.at[k].add(-h))) / (2 * h) for k in range(2)]
    np.testing.assert_allclose(jax.grad(f)(theta), central, rtol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(f)(theta), jax.grad(f)(theta), rtol=1e-9)


def test_a_scene_with_a_follower_has_no_energy():
    with pytest.raises(InputError, match="the follower pressure on 'right' has no potential"):
        potential_energy(pressed())
