from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.energy import local_forces, potential_energy
from emulator.geometry.refinement import to_quadratic
from emulator.scenes.loads import CavityPressure, FollowerPressure
from scene_support import block, rotation


def pressed(order=1, pressure=2.0):
    scene = block(loads=(FollowerPressure("right", pressure),), cells=(2, 1, 1))
    return scene if order == 1 else replace(scene, mesh=to_quadratic(scene.mesh))


@pytest.mark.parametrize("order", [1, 2])
def test_force_is_pressure_times_area_and_turns_with_the_patch(order):
    scene = pressed(order)
    (term,) = local_forces(scene)
    # The right face is 3 x 4 mm, its outward normal x: 2 kPa push with 24 mN along -x.
    force = term.total(jnp.zeros(scene.held.shape), {}).sum(axis=0)
    np.testing.assert_allclose(force, [-24.0, 0.0, 0.0], atol=1e-12)
    R = rotation()
    turned = jnp.asarray(scene.mesh.nodes @ (R - np.eye(3)).T)
    np.testing.assert_allclose(term.total(turned, {}).sum(axis=0), R @ force, atol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_tangent_is_the_derivative_of_the_force_and_not_symmetric(order):
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
def test_equal_to_the_cavity_where_the_rim_is_held():
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


def test_a_scene_with_one_has_no_energy():
    with pytest.raises(InputError, match="the follower pressure on 'right' has no potential"):
        potential_energy(pressed())
