from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.fem.energy import dead_force, pair_products, potential_energy, strain_energy
from emulator.geometry.generators.box import box
from emulator.mechanics.laws import find_law
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


def sheeted(fibres, sheets):
    """A quadratic block of fibres and sheets, and a homogeneous displacement of it."""
    scene = block()
    mesh = box((2.0, 3.0, 4.0), (2, 1, 1), order=2)
    law = find_law("holzapfel_ogden_orthotropic")
    values = {name: 1.0 + 0.1 * k for k, name in enumerate(law.parameters)}
    free = replace(scene.parameters[0], name=law.parameters[0], unit="kPa")
    values.pop(free.name)
    H = 0.2 * np.random.default_rng(0).normal(size=(3, 3))
    directed = replace(
        scene, mesh=mesh, law=law, parameters=(free,), constants=values,
        fibres=fibres, sheets=sheets, origin={},
    )  # fmt: skip
    return directed, jnp.asarray(mesh.nodes @ H.T)


@pytest.mark.parametrize("dilatation", ["pointwise", "mean"])
def test_each_point_has_its_own_fibre_and_sheet(dilatation):
    """Directions of elements are those of all their points; two kinds add up by their volumes."""
    count = 12
    kinds = [np.eye(3)[[0, 1]], np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])]
    of_elements, of_points, weights = [], [], None
    for fibre, sheet in kinds:
        energies = []
        for shape in ((count, 3), (count, 4, 3)):
            scene, u = sheeted(np.broadcast_to(fibre, shape), np.broadcast_to(sheet, shape))
            scene = replace(scene, dilatation=dilatation)
            energies.append(float(strain_energy(scene)(u, scene.centre)))
        of_elements.append(energies[0])
        of_points.append(energies[1])
        weights = scene.discretisation.weights
    np.testing.assert_allclose(of_points, of_elements, rtol=1e-14)
    first = np.random.default_rng(1).random((count, 4)) < 0.5
    fibres, sheets = (np.where(first[:, :, None], kinds[0][k], kinds[1][k]) for k in (0, 1))
    scene, u = sheeted(fibres, sheets)
    scene = replace(scene, dilatation=dilatation)
    share = weights[first].sum() / weights.sum()
    expected = share * of_points[0] + (1.0 - share) * of_points[1]
    assert float(strain_energy(scene)(u, scene.centre)) == pytest.approx(expected, rel=1e-12)
    assert of_points[0] != pytest.approx(of_points[1], rel=1e-3)


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
    from emulator.mechanics.kinematics import Barriers

    u = simulator(beam.centre)
    exact = potential_energy(beam)(u, beam.centre)
    limited = potential_energy(beam, Barriers())(u, beam.centre)
    assert limited == pytest.approx(float(exact), rel=1e-12)
    crushed = u.at[:, 0].add(-3.0 * beam.mesh.nodes[:, 0])
    assert np.isnan(potential_energy(beam)(crushed, beam.centre))
    assert np.isfinite(potential_energy(beam, Barriers())(crushed, beam.centre))


def test_products_of_pairs_are_those_of_the_whole_blocks():
    rng = np.random.default_rng(3)
    whole = rng.normal(size=(2, 15, 15))
    whole = whole + whole.transpose(0, 2, 1)
    one, other = np.triu_indices(5)
    pairs = whole.reshape(2, 5, 3, 5, 3)[:, one, :, other].transpose(1, 0, 2, 3)
    x = rng.normal(size=(2, 5, 3))
    expected = np.einsum("bij,bj->bi", whole, x.reshape(2, 15)).reshape(2, 5, 3)
    np.testing.assert_allclose(pair_products(jnp.asarray(pairs), jnp.asarray(x)), expected)
