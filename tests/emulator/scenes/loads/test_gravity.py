"""Dead weight in one direction, against the same weight with its direction as a parameter."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.energy import dead_force, potential_energy
from emulator.scenes.loads import Gravity, GravityVector
from emulator.scenes.parameter_space import Parameter
from scene_support import block

G = jnp.array([1.5, -4.0, -8.0])  # m/s2


@pytest.fixture(scope="module")
def turned():
    """A block that may be turned; theta = (mu, lam, gravity_x, gravity_y, gravity_z)."""
    axes = tuple(Parameter(f"gravity_{axis}", "m/s2", -20.0, 20.0) for axis in "xyz")
    scene = block()
    return replace(
        scene, parameters=(*scene.parameters, *axes), loads=(GravityVector(density=30.0),)
    )


@pytest.fixture(scope="module")
def fixed():
    size = float(jnp.linalg.norm(G))
    return block(loads=(Gravity(density=30.0, direction=tuple(map(float, G)), acceleration=size),))


def test_it_deforms_as_gravity_in_that_direction(turned, fixed):
    material = jnp.array([2.0, 3.0])
    u = em.Simulator(turned)(jnp.concatenate([material, G]))
    expected = em.Simulator(fixed)(material)
    np.testing.assert_allclose(u, expected, atol=1e-8 * np.abs(expected).max())
    assert np.abs(expected).max() > 0.1


def test_the_energy_s_slope_is_the_weight_s_work(turned):
    """d Pi / dg = -rho int u dX: for a uniform lift of 1 mm, minus the mass of 30 x 24 mm3."""
    u = jnp.zeros(turned.held.shape).at[:, 2].set(1.0)
    theta = jnp.concatenate([turned.centre[:2], G])
    slope = jax.grad(potential_energy(turned), argnums=1)(u, theta)
    np.testing.assert_allclose(slope[2:], [0.0, 0.0, -30.0 * 24.0 * 1e-3], atol=1e-12)


def test_fem_s_slope_along_gravity(turned):
    simulator = em.Simulator(turned)
    theta = jnp.concatenate([turned.centre[:2], G])
    step = jnp.zeros(5).at[3].set(1.0)
    _, slope = jax.jvp(lambda t: simulator.solve(t).displacement, (theta,), (step,))
    ahead, behind = (simulator(theta + h * step) for h in (0.01, -0.01))
    np.testing.assert_allclose(slope, (ahead - behind) / 0.02, atol=1e-5 * np.abs(slope).max())


def test_two_vectors_of_one_name_add_up(turned, fixed):
    twice = replace(turned, loads=(GravityVector(density=10.0), GravityVector(density=20.0)))
    values = turned.resolve(jnp.concatenate([turned.centre[:2], G]))
    total = dead_force(twice).total(values)
    np.testing.assert_allclose(total, dead_force(turned).total(values), rtol=1e-12)
    np.testing.assert_allclose(total, dead_force(fixed).constant, atol=1e-12)


def test_a_fixed_direction_costs_nothing_more(fixed):
    assert not dead_force(fixed).per_unit
    jaxpr = str(jax.make_jaxpr(lambda v: dead_force(fixed).total(v))({}))
    assert "mul" not in jaxpr


def test_what_cannot_be_is_refused(turned):
    with pytest.raises(InputError, match="gravity_vector: density is -1"):
        GravityVector(density=-1.0)
    with pytest.raises(InputError, match="'gravity_x' is in kPa; load GravityVector takes m/s2"):
        replace(
            turned,
            parameters=(*turned.parameters[:2], Parameter("gravity_x", "kPa", -1.0, 1.0)),
            constants={"gravity_y": 0.0, "gravity_z": 0.0},
        )
