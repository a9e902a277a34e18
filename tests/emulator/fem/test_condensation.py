from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.condensation import consistent, linearise
from emulator.fem.energy import pair_products, strain_energy
from emulator.verify.consistency import block


@pytest.fixture(scope="module")
def scene():
    return block("P2, mean dilatation")


@pytest.fixture(scope="module")
def state(scene):
    rng = np.random.default_rng(0)
    return jnp.asarray(0.05 * rng.normal(size=scene.held.shape)), scene.centre


def spread(scene, local):
    nodes = scene.discretisation.connectivity
    return jnp.zeros(scene.held.shape).at[nodes].add(local.reshape(*nodes.shape, 3))


@pytest.mark.slow
def test_consistent_volumes_give_the_force_and_tangent_of_the_energy(scene, state):
    u, theta = state
    at = linearise(scene, u, consistent(scene, u, theta), theta)
    energy = strain_energy(scene)
    np.testing.assert_allclose(spread(scene, at.force), jax.grad(energy)(u, theta), atol=1e-10)
    np.testing.assert_allclose(at.couplings.residuals.pressure, 0.0, atol=1e-10)
    np.testing.assert_allclose(at.couplings.residuals.change, 0.0, atol=1e-12)
    v = jnp.asarray(np.random.default_rng(1).normal(size=u.shape))
    product = spread(scene, pair_products(at.tangent, v[scene.discretisation.connectivity]))
    _, expected = jax.jvp(lambda w: jax.grad(energy)(w, theta), (u,), (v,))
    np.testing.assert_allclose(product, expected, atol=1e-8 * float(jnp.abs(expected).max()))


@pytest.mark.slow
def test_a_step_makes_the_constraint_hold_to_first_order(scene, state):
    u, theta = state
    volumes = consistent(scene, u, theta)
    at = linearise(scene, u, volumes, theta)
    v = jnp.asarray(np.random.default_rng(2).normal(size=u.shape))
    local, left = v[scene.discretisation.connectivity], []
    for h in (1e-2, 5e-3):
        after = at.couplings.advance(volumes, h * local, jnp.array(1.0))
        own = consistent(scene, u + h * v, theta)
        left.append(float(jnp.abs(after.change - own.change).max()))
    assert left[0] / left[1] == pytest.approx(4.0, rel=0.05)


@pytest.mark.slow
def test_as_many_iterations_however_incompressible(scene):
    # On the displacements alone nu = 0.49999 takes hundreds.
    simulator = em.Simulator(scene)
    soft, stiff = (simulator.solve(jnp.array([10.0, kappa])) for kappa in (30.0, 5e5))
    assert soft.converged
    assert stiff.converged
    assert stiff.iterations <= soft.iterations + 4


def test_mean_dilatation_on_linear_elements_is_refused():
    scene = block("P1")
    with pytest.raises(InputError, match="they have one point each; make the mesh quadratic"):
        replace(scene, dilatation="mean")
    with pytest.raises(InputError, match="dilatation 'none'; use pointwise, mean"):
        replace(scene, dilatation="none")
