"""Scenes whose mesh is the loaded shape of an image: unload, load, answer from the mesh."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.campaign.designs import design
from emulator.fem.loaded import LoadedEquilibrium, image_theta
from emulator.geometry.facets import Cavity

IMAGED = em.Parameter("imaged", "kPa", 0.3, 1.5)
PART = jnp.array([0.3, -0.2, 0.5, 0.1, -0.4, 0.3])  # of theta, a direction


def seen(scene, **changes):
    """``scene`` taken from an image, whose pressure is a parameter."""
    parameters = (*scene.parameters, IMAGED)
    made = {"loaded_by": {"pressure": "imaged"}, "parameters": parameters, "origin": {}}
    return replace(scene, **{**made, **changes})


@pytest.fixture(scope="module")
def imaged(ventricle):
    return seen(ventricle)


@pytest.fixture(scope="module")
def simulator(imaged):
    return em.Simulator(imaged)


def theta_of(pressure, image):
    return jnp.array([0.4, 2.0, 6.0, 2.0, pressure, image])


def test_the_image_has_loads_of_its_own(imaged, ventricle):
    np.testing.assert_array_equal(image_theta(imaged, theta_of(1.2, 0.8)), theta_of(0.8, 0.8))
    np.testing.assert_array_equal(
        image_theta(ventricle, theta_of(1.2, 0)[:5]), theta_of(1.2, 0)[:5]
    )
    assert imaged.load_parameters == ("pressure",)
    at_rest = replace(ventricle, origin={})
    fixed = seen(
        ventricle, parameters=ventricle.parameters, constants={**ventricle.constants, "imaged": 0.9}
    )
    np.testing.assert_array_equal(image_theta(fixed, theta_of(1.2, 0)[:5])[4], 0.9)
    itself = seen(ventricle, parameters=ventricle.parameters, loaded_by={"pressure": "pressure"})
    assert len({s.fingerprint for s in (imaged, fixed, itself, at_rest)}) == 4
    assert not itself.identity.agrees(at_rest.identity)


@pytest.mark.slow
def test_a_solve_unloads_and_loads(simulator, ventricle):
    theta = theta_of(1.2, 0.8)
    found = simulator.solve(theta).require_converged()
    unloaded = em.fem.unload(ventricle, image_theta(simulator.scene, theta)[:5])
    loaded = em.Simulator(unloaded.scene).solve(theta[:5])
    by_hand = unloaded.displacement + loaded.displacement
    np.testing.assert_allclose(found.displacement, by_hand, atol=1e-10)
    again = simulator.solve(theta, found.displacement)
    np.testing.assert_allclose(again.displacement, by_hand, atol=1e-9)
    assert int(again.iterations) < int(found.iterations)


@pytest.mark.slow
def test_at_the_pressure_of_the_image_nothing_moves(simulator, imaged):
    theta = theta_of(0.8, 0.8)
    at_rest = LoadedEquilibrium(imaged, em.fem.NewtonOptions()).unloaded(theta)
    still = simulator.solve(theta, at_rest.displacement).require_converged()
    assert float(jnp.abs(still.displacement).max()) < 1e-8
    assert int(still.iterations) > int(at_rest.iterations)  # loaded from rest
    assert not np.asarray(simulator.solve(theta).displacement).any()  # begun at the mesh
    # The cavity of the image, and less of it under less pressure.
    cavity = Cavity(imaged.mesh, "endocardium")
    u = simulator.solve(theta_of(0.5, 0.8)).displacement
    assert float(cavity(u[cavity.nodes])) < cavity.rest


@pytest.mark.slow
@pytest.mark.parametrize("dilatation", ["pointwise", "mean"])
def test_derivatives_follow_by_the_chain_rule(dilatation):
    order = 1 if dilatation == "pointwise" else 2
    scene = em.scenes.left_ventricle(3, 6, 1, order=order)
    simulator = em.Simulator(seen(replace(scene, dilatation=dilatation)))
    theta, step = theta_of(1.2, 0.8), 1e-4

    def u(theta):
        return simulator.solve(theta).displacement

    direction = PART * theta
    difference = (u(theta + step * direction) - u(theta - step * direction)) / (2.0 * step)
    size = float(jnp.abs(difference).max())
    rows = simulator.sensitivities(u(theta), theta)
    np.testing.assert_allclose(jnp.tensordot(direction, rows, 1), difference, atol=1e-6 * size)
    if dilatation == "mean":  # ways through other programs differ in nothing more
        return
    along = jax.jvp(u, (theta,), (direction,))[1]
    np.testing.assert_allclose(along, difference, atol=1e-6 * size)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=along.shape))
    slope = jax.jit(jax.grad(lambda theta: jnp.vdot(weights, u(theta))))(theta)
    assert float(slope @ direction) == pytest.approx(float(jnp.vdot(weights, along)), rel=1e-8)
    _, gradient = simulator.gradient_of(lambda u, _: jnp.vdot(weights, u))(u(theta), theta)
    np.testing.assert_allclose(gradient, slope, rtol=1e-7, atol=1e-9 * float(jnp.abs(slope).max()))


@pytest.mark.slow
def test_a_campaign_and_emulators(simulator, imaged, tmp_path):
    runs = em.fem.run_campaign(simulator, design(imaged, 20, 0), sensitivities=True)
    assert np.isnan(runs.energy).all()
    reduced = em.fit_reduced(imaged, runs)
    at_a_run = reduced(runs.theta[3])
    np.testing.assert_allclose(at_a_run, runs.displacement[3], atol=0.05)
    plan = replace(em.recipe("mechanics"), simulations=10, order=1)
    forward = em.train(imaged, plan, tmp_path).cache()
    np.testing.assert_allclose(forward(runs.theta[3]), runs.displacement[3], atol=0.1)
    errors = em.evaluate(forward, runs.theta, runs.displacement)
    off = np.linalg.norm(jax.vmap(forward)(runs.theta) - runs.displacement, axis=-1)
    assert errors["err_u"]["mean"] == pytest.approx(off.mean())
    assert "err_V" in errors
    assert "err_Pi" not in errors


def test_threads_share_the_recent_shapes(imaged, monkeypatch):
    solves = []
    monkeypatch.setattr(em.fem.Unloader, "solve", lambda _, theta: solves.append(theta) or theta)
    loaded = LoadedEquilibrium(imaged, em.fem.NewtonOptions())
    thetas = [theta_of(1.0, 0.3 + 0.01 * k) for k in range(40)]
    with ThreadPoolExecutor(8) as pool:
        shapes = list(pool.map(loaded.unloaded, thetas))
    for theta, shape in zip(thetas, shapes, strict=True):
        np.testing.assert_array_equal(shape, image_theta(imaged, theta))
    before = len(solves)
    loaded.unloaded(thetas[0])  # long forgotten
    loaded.unloaded(thetas[0])
    assert len(solves) == before + 1
    assert loaded._recent.cache_info().currsize == 16


@pytest.mark.slow
def test_a_failure_to_unload_is_that_of_the_solve(simulator):
    lost = simulator.solve(theta_of(1.0, 1e7))
    assert not lost.converged
    assert not np.asarray(lost.displacement).any()


NEEDING_REST = [
    lambda scene: em.Simulator(scene).system,
    lambda scene: em.fem.potential_energy(scene),
    lambda scene: em.fem.unload(scene, theta_of(1.0, 0.8)),
    lambda scene: em.fem.element_fields(scene, np.zeros(scene.held.shape), theta_of(1.0, 0.8)),
    lambda scene: em.Simulator(scene).reactions(np.zeros(scene.held.shape), theta_of(1.0, 0.8)),
    lambda scene: em.train(scene, em.recipe("physics"), "nowhere"),
    lambda scene: em.train(scene, em.recipe("sweeps"), "nowhere"),
]


@pytest.mark.parametrize("needs", NEEDING_REST)
def test_what_needs_a_scene_at_rest_says_so(needs, imaged, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="is known under load .loaded_by., and this needs a scene"):
        needs(imaged)
    assert not list(tmp_path.iterdir())


def test_what_was_said_wrong_of_the_image(ventricle):
    with pytest.raises(
        InputError, match="loaded_by: 'push' is no parameter of a load; there are p"
    ):
        seen(ventricle, loaded_by={"push": "imaged"})
    with pytest.raises(InputError, match="'pressure' in the image needs 'imaged'"):
        seen(ventricle, parameters=ventricle.parameters)
    with pytest.raises(InputError, match="parameter 'imaged' is not one of law"):
        seen(ventricle, loaded_by={})
    other = em.Parameter("imaged", "mmHg", 4.0, 10.0)
    with pytest.raises(InputError, match="imaged.*kPa"):
        seen(ventricle, parameters=(*ventricle.parameters, other))
    constant = {**ventricle.constants, "pressure": 1.0}
    with pytest.raises(InputError, match="loaded_by: 'pressure' is a constant, so the mesh is"):
        seen(ventricle, parameters=(*ventricle.parameters[:4], IMAGED), constants=constant)


@pytest.mark.slow
def test_stability_and_the_error_of_the_mesh(simulator):
    theta = theta_of(1.2, 0.8)
    u = simulator(theta)
    assert simulator.is_stable(u, theta)
    assert not simulator.is_stable(u * jnp.nan, theta)
    maker = em.mesh_error(simulator)
    error = maker(theta)
    np.testing.assert_allclose(error.coarse, u, atol=1e-9)
    np.testing.assert_allclose(error.fine, maker.fine(theta), atol=1e-6)
    assert float(error.err_u.max()) > 1e-3
