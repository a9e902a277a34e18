import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.fem.functional import dead_force, potential_energy, strain_energy
from emulator.scenes.loads import Gravity
from scene_support import block, rotation

VOLUME = 2.0 * 3.0 * 4.0


def test_a_uniform_deformation_has_the_law_energy_times_the_volume():
    scene = block()
    H = 0.2 * np.random.default_rng(0).normal(size=(3, 3))
    u = scene.mesh.nodes @ H.T
    F = np.eye(3) + H
    J, mu, lam = np.linalg.det(F), 2.0, 5.0
    density = 0.5 * mu * (np.sum(F * F) - 3.0) - mu * np.log(J) + 0.5 * lam * np.log(J) ** 2
    energy = potential_energy(scene)(jnp.asarray(u), jnp.array([mu, lam]))
    assert energy == pytest.approx(VOLUME * density, rel=1e-12)


def test_a_rigid_rotation_costs_no_energy_and_no_force():
    scene = block()
    u = jnp.asarray(scene.mesh.nodes @ (rotation() - np.eye(3)).T)
    value, force = jax.value_and_grad(strain_energy(scene))(u, scene.centre)
    assert abs(value) < 1e-11
    np.testing.assert_allclose(force, 0.0, atol=1e-12)


def test_weight_in_hand_units():
    # 24 mm3 of water weigh 24e-6 kg * 9.81 m/s2 = 2.3544e-4 N = 0.23544 mN.
    scene = block(loads=(Gravity(density=1.0, direction=(0.0, 0.0, -2.0)),))
    force = dead_force(scene).constant
    np.testing.assert_allclose(force.sum(axis=0), [0.0, 0.0, -0.23544], atol=1e-12)
    # Lifting the body by 1 mm against it takes as much work.
    up = jnp.zeros(scene.held.shape).at[:, 2].set(1.0)
    assert potential_energy(scene)(up, scene.centre) == pytest.approx(0.23544)


def test_a_scene_without_loads_computes_none():
    theta = block().centre
    operations = {}
    for name, loads in (("none", ()), ("one", (Gravity(),)), ("two", (Gravity(), Gravity()))):
        scene = block(loads=loads)
        jaxpr = jax.make_jaxpr(potential_energy(scene))(jnp.zeros(scene.held.shape), theta)
        operations[name] = sum(1 for _ in jaxpr.jaxpr.eqns)
    assert operations["none"] == sum(
        1
        for _ in jax.make_jaxpr(strain_energy(block()))(
            jnp.zeros(block().held.shape), theta
        ).jaxpr.eqns
    )
    assert operations["none"] < operations["one"]
    assert operations["one"] == operations["two"]  # dead loads are summed before tracing


def test_barriers_leave_a_sound_state_untouched(beam, simulator):
    from emulator.mechanics.barriers import Barriers

    u = simulator(beam.centre)
    exact = potential_energy(beam)(u, beam.centre)
    limited = potential_energy(beam, Barriers())(u, beam.centre)
    assert limited == pytest.approx(float(exact), rel=1e-12)
    crushed = u.at[:, 0].add(-3.0 * beam.mesh.nodes[:, 0])
    assert np.isnan(potential_energy(beam)(crushed, beam.centre))
    assert np.isfinite(potential_energy(beam, Barriers())(crushed, beam.centre))
