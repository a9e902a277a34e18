import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import emulator as em
from emulator.fem.fields import _first_piola, element_fields
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from scene_support import block, rotation

MU, LAM = 3.0, 7.0


def with_fibres() -> Scene:
    plain = block()
    fibres = np.tile([0.6, 0.8, 0.0], (len(plain.mesh.elements), 1))
    return Scene(
        name="fibrous",
        mesh=plain.mesh,
        law=find_law("guccione"),
        parameters=(Parameter("C", "kPa", 1.0, 5.0),),
        supports=(Support("left"),),
        constants={"b_f": 8.0, "b_t": 2.0, "b_fs": 4.0, "kappa": 50.0},
        fibres=fibres,
    )


def test_uniaxial_stress_turned_in_space():
    scene, stretch = block(), 1.3
    # sigma = mu/J (b - I) + lam ln(J)/J I, free of stress across.
    t = brentq(lambda t: MU * (t**2 - 1) + LAM * np.log(stretch * t**2), 0.5, 1.5, xtol=1e-14)
    J = stretch * t**2
    tension = (MU * (stretch**2 - 1) + LAM * np.log(J)) / J
    U, R = np.diag([stretch, t, t]), rotation()
    u = scene.mesh.nodes @ (R @ U - np.eye(3)).T
    fields = element_fields(scene, jnp.asarray(u), jnp.array([MU, LAM]))
    m = len(scene.mesh.elements)
    np.testing.assert_allclose(fields["J"], np.full(m, J), rtol=1e-13)
    expected = tension * np.outer(R[:, 0], R[:, 0])
    np.testing.assert_allclose(fields["cauchy_stress"], np.tile(expected, (m, 1, 1)), atol=1e-12)
    strain = np.diag((np.array([stretch, t, t]) ** 2 - 1) / 2)
    np.testing.assert_allclose(fields["green_lagrange"], np.tile(strain, (m, 1, 1)), atol=1e-13)
    assert sorted(fields) == ["J", "cauchy_stress", "green_lagrange"]


def test_stress_is_symmetric_and_its_work_is_the_energy():
    from emulator.fem.energy import strain_energy

    scene = with_fibres()
    rng = np.random.default_rng(2)
    u = jnp.asarray(0.1 * rng.normal(size=scene.mesh.nodes.shape))
    theta = scene.centre
    fields = element_fields(scene, u, theta)
    sigma = fields["cauchy_stress"]
    np.testing.assert_array_equal(sigma, np.swapaxes(sigma, 1, 2))
    # A small step v costs int sigma : grad(v) dx, with grad in the deformed body.
    v = rng.normal(size=u.shape)
    step, energy = 1e-5, strain_energy(scene)
    rate = (energy(u + step * v, theta) - energy(u - step * v, theta)) / (2 * step)
    grid = scene.discretisation
    dv = np.einsum("mai,maj->mij", v[grid.connectivity], grid.gradients[:, 0])
    F = np.eye(3) + np.einsum(
        "mai,maj->mij", np.asarray(u)[grid.connectivity], grid.gradients[:, 0]
    )
    volume = grid.weights[:, 0] * fields["J"]
    work = np.einsum("m,mij,mij->", volume, sigma, dv @ np.linalg.inv(F))
    assert work == pytest.approx(float(rate), rel=1e-7)


def test_fibres_are_carried_along():
    scene = with_fibres()
    F = np.diag([1.5, 0.9, 1.0]) + 0.1 * np.eye(3, k=1)
    u = scene.mesh.nodes @ (F - np.eye(3)).T
    fields = element_fields(scene, jnp.asarray(u), scene.centre)
    along = F @ [0.6, 0.8, 0.0]
    m = len(scene.mesh.elements)
    np.testing.assert_array_equal(fields["fibres"], scene.fibres)
    np.testing.assert_allclose(
        fields["deformed_fibres"], np.tile(along / np.linalg.norm(along), (m, 1)), rtol=1e-13
    )
    np.testing.assert_allclose(fields["fibre_stretch"], np.full(m, np.linalg.norm(along)))


def test_means_are_weighted_by_volume():
    scene = block()
    grid = scene.discretisation
    # The same points twice, unevenly weighted: nothing may change.
    doubled = dataclasses.replace(
        grid,
        gradients=np.repeat(grid.gradients, 2, axis=1),
        values=np.repeat(grid.values, 2, axis=0),
        weights=np.concatenate([0.2 * grid.weights, 0.8 * grid.weights], axis=1),
    )
    u = jnp.asarray(0.1 * np.random.default_rng(3).normal(size=scene.mesh.nodes.shape))
    once = element_fields(scene, u, scene.centre)
    vars(scene).update(discretisation=doubled, blocks=doubled)  # where cached_property keeps them
    for name, values in element_fields(scene, u, scene.centre).items():
        np.testing.assert_allclose(
            values, once[name], rtol=1e-13, atol=1e-14 * np.abs(once[name]).max()
        )


def test_mean_dilatation_on_quadratic_elements():
    """Stress is symmetric, and its volume mean is the mean of what the nodal forces do."""
    from emulator.fem.energy import strain_energy
    from emulator.geometry.refinement import to_quadratic

    plain = block()
    mesh = to_quadratic(plain.mesh)
    scene = dataclasses.replace(plain, mesh=mesh, dilatation="mean")
    rng = np.random.default_rng(4)
    u, theta = jnp.asarray(0.03 * rng.normal(size=mesh.nodes.shape)), scene.centre
    force = jax.grad(strain_energy(scene))(u, theta)
    # int P dX = sum of f x X, and int tau dX = sum of f x (X + u), tau = J sigma.
    P = _first_piola(scene, scene.gradients(u), theta)
    F = scene.gradients(u) + np.eye(3)
    tau = jnp.einsum("mq,mqij,mqkj->ik", scene.discretisation.weights, P, F)
    expected = force.T @ (mesh.nodes + u)
    np.testing.assert_allclose(tau, expected, atol=1e-11)
    np.testing.assert_allclose(tau, tau.T, atol=1e-11)
    sigma = element_fields(scene, u, theta)["cauchy_stress"]
    np.testing.assert_array_equal(sigma, np.swapaxes(sigma, 1, 2))


def test_the_old_name_of_gradients_warns(beam):
    u = 0.01 * np.ones((beam.node_count, 3))
    with pytest.warns(DeprecationWarning, match=r"goes in 0.11; write scene.gradients\(u\)"):
        H = em.fem.displacement_gradient(beam, u)
    np.testing.assert_array_equal(H, beam.gradients(u))
