from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.condensation import consistent, linearise
from emulator.fem.energy import strain_energy
from emulator.fem.fields import element_fields
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter
from emulator.scenes.loads import Gravity
from emulator.verify.consistency import block as quadratic_block
from scene_support import block, slope

COARSE = {"rings": 5, "around": 12, "layers": 1}
FACTORS = (Parameter("stiffness_2", "", 0.5, 2.0, "log"), Parameter("stiffness_7", "", 0.5, 2.0))


@pytest.fixture(scope="module")
def ventricle():
    return em.scenes.left_ventricle_segments(**COARSE, order=1)


@pytest.fixture(scope="module")
def state(ventricle):
    """A displacement that strains everything, and an uneven theta."""
    rng = np.random.default_rng(0)
    u = 0.3 * rng.normal(size=ventricle.held.shape)
    unit = rng.uniform(0.1, 0.9, size=len(ventricle.parameters))
    return jnp.asarray(u), ventricle.from_unit(jnp.asarray(unit))


@pytest.fixture(scope="module")
def force(ventricle):
    return jax.jit(System(ventricle).internal_force)


def halves(scene=None):
    """A block whose left half is region 2 and whose right half is region 7."""
    scene = block() if scene is None else scene
    centroids = scene.mesh.nodes[scene.mesh.elements[:, :4]].mean(axis=1)
    middle = scene.mesh.nodes[:, 0].mean()
    regions = np.where(centroids[:, 0] < middle, 2, 7)
    return replace(scene, regions=regions, parameters=(*scene.parameters, *FACTORS))


def everything(scene):
    """Energy, residual and tangent at (u, theta)."""
    system = System(scene)
    parts = (system.internal_energy, system.residual, system.tangent)
    return jax.jit(lambda u, theta: [part(u, theta) for part in parts])


def with_stiffness(scene, theta, **factors):
    names = list(scene.parameter_names)
    for name, value in factors.items():
        theta = theta.at[names.index(name)].set(value)
    return theta


def test_a_uniform_deformation_has_the_energy_of_each_half():
    scene = halves()
    F = np.eye(3) + 0.2 * np.random.default_rng(1).normal(size=(3, 3))
    u = jnp.asarray(scene.mesh.nodes @ (F - np.eye(3)).T)
    J, mu, lam = np.linalg.det(F), 2.0, 5.0
    shape = 0.5 * mu * (np.sum(F * F) - 3.0) - mu * np.log(J)
    volume = 0.5 * lam * np.log(J) ** 2
    expected = 12.0 * (0.5 * shape + volume) + 12.0 * (1.7 * shape + volume)  # 12 mm3 a half
    theta = scene.theta(mu=mu, lam=lam, stiffness_2=0.5, stiffness_7=1.7)
    assert jax.jit(strain_energy(scene))(u, theta) == pytest.approx(expected, rel=1e-12)
    assert scene.resolve(theta)["stiffness_7"] == 1.7
    np.testing.assert_array_equal(element_fields(scene, u, theta)["regions"], scene.regions)


def test_a_factor_may_be_constant(strict):
    scene = halves()
    fixed = replace(scene, parameters=scene.parameters[:3], constants={"stiffness_7": 1.7})
    u = jnp.asarray(0.05 * np.random.default_rng(1).normal(size=scene.held.shape))
    theta = jnp.array([2.0, 5.0, 0.5, 1.7])
    expected = jax.jit(jax.value_and_grad(strain_energy(scene)))(u, theta)
    ours = jax.jit(jax.value_and_grad(strain_energy(fixed)))(u, theta[:3])
    assert ours[0] == pytest.approx(float(expected[0]), rel=1e-13)
    np.testing.assert_allclose(ours[1], expected[1], rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def all_of(ventricle):
    return everything(ventricle)


@pytest.mark.slow
def test_factors_of_one_are_the_plain_ventricle(ventricle, state, all_of):
    plain = em.scenes.left_ventricle(**COARSE, order=1)
    u, _ = state
    theta = ventricle.centre.at[-1].set(0.9)
    np.testing.assert_allclose(theta[:-1], 1.0, rtol=1e-15)
    same = plain.centre.at[-1].set(0.9)
    for found, expected in zip(all_of(u, theta), everything(plain)(u, same), strict=True):
        atol = 1e-13 * float(jnp.abs(expected).max())
        np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
    assert ventricle.fingerprint != plain.fingerprint


@pytest.mark.parametrize("segment", [3, 10, 15, 17])
def test_a_segment_pulls_at_its_own_nodes_alone(ventricle, state, force, segment):
    u, theta = state
    stiffer = with_stiffness(ventricle, theta, **{f"stiffness_{segment}": 1.9})
    change = np.asarray(force(u, stiffer) - force(u, theta))
    nodes = np.unique(ventricle.mesh.elements[ventricle.regions == segment])
    others = np.setdiff1d(np.arange(len(change)), nodes)
    assert (change[others] == 0.0).all()
    assert (np.abs(change[nodes]).max(axis=1) > 1e-3).all()


def test_resistance_to_volume_change_is_the_same_everywhere(ventricle):
    # Swelling by J = 1.1 everywhere has no isochoric strain: kappa alone resists it.
    J = 1.1
    u = jnp.asarray((J ** (1 / 3) - 1.0) * ventricle.mesh.nodes)
    energy = jax.jit(jax.value_and_grad(strain_energy(ventricle), argnums=1))
    volume = ventricle.discretisation.weights.sum()
    expected = 25.0 * (J**2 - 1.0 - 2.0 * np.log(J)) * volume
    for factor in (0.5, 2.0):
        value, slopes = energy(u, ventricle.centre.at[:-1].set(factor))
        assert value == pytest.approx(expected, rel=1e-12)
        np.testing.assert_allclose(slopes, 0.0, atol=1e-9 * expected)


def test_the_tangent_is_the_derivative_of_the_residual_taylor(ventricle, state, all_of):
    u, theta = state
    system = System(ventricle)
    rng = np.random.default_rng(4)
    image = jnp.asarray(rng.normal(size=len(system.free)))
    # The direction that the tangent takes to an image: K v without a product of our own.
    _, at, tangent = all_of(u, theta)
    free = system.solve(tangent, image)
    change = system.extend(free)
    steps = 0.1 / float(jnp.abs(free).max()) / 2.0 ** np.arange(5)
    ahead = [all_of(u + h * change, theta)[1] for h in steps]
    left = [np.linalg.norm(r - at - h * image) for h, r in zip(steps, ahead, strict=True)]
    assert slope(steps, np.array(left)) == pytest.approx(2.0, abs=0.15)


def test_the_residual_in_theta_taylor(ventricle, state):
    u, theta = state
    residual = System(ventricle).residual
    rng = np.random.default_rng(5)
    direction = jnp.asarray(rng.normal(size=len(theta)))
    weights = jnp.asarray(rng.normal(size=len(System(ventricle).free)))
    along = jax.jit(jax.value_and_grad(lambda t: jnp.vdot(weights, residual(u, t))))
    value, gradient = along(theta)
    # Linear in each factor and in the pressure: differences of any size are derivatives.
    for k in (0, 8, 16, 17):
        moved, _ = along(theta.at[k].add(0.25))
        assert 4.0 * (moved - value) == pytest.approx(float(gradient[k]), rel=1e-6)
    moved, _ = along(theta + 0.1 * direction)
    assert moved - value == pytest.approx(0.1 * float(gradient @ direction), rel=1e-8)


def test_solutions_in_theta_taylor():
    scene = halves(block(loads=(Gravity(density=500.0),)))
    simulator = em.Simulator(scene)
    weights = jnp.asarray(np.random.default_rng(6).normal(size=scene.held.shape))
    function = lambda t: jnp.vdot(weights, simulator(t))
    theta = scene.theta(mu=3.0, lam=5.0, stiffness_2=0.7, stiffness_7=1.4)
    direction = jnp.array([0.0, 0.0, 1.0, -0.7])
    u = simulator(theta)
    value = jnp.vdot(weights, u)
    gradient = jnp.tensordot(simulator.sensitivities(u, theta), weights, axes=2)
    assert (jnp.abs(gradient[2:]) > 1e-3).all()
    steps = 0.1 / 2.0 ** np.arange(4)
    ahead = np.array([function(theta + h * direction) for h in steps])
    left = np.abs(ahead - value - steps * (gradient @ direction))
    assert slope(steps, left) == pytest.approx(2.0, abs=0.15)


@pytest.mark.slow
def test_mean_dilatation_has_regions_too():
    scene = halves(quadratic_block("P2, mean dilatation"))
    u = jnp.asarray(0.05 * np.random.default_rng(0).normal(size=scene.held.shape))
    theta = with_stiffness(scene, scene.centre, stiffness_2=0.6, stiffness_7=1.9)
    spread = jax.jit(
        lambda u, t: System(scene).scatter(linearise(scene, u, consistent(scene, u, t), t).force)
    )
    force = spread(u, theta)
    expected = jax.jit(jax.grad(strain_energy(scene)))(u, theta)
    np.testing.assert_allclose(force, expected, atol=1e-10)
    even = with_stiffness(scene, theta, stiffness_2=1.0, stiffness_7=1.0)
    assert float(jnp.abs(force - spread(u, even)).max()) > 1e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"regions": np.ones(3, int)}, r"regions have shape \(3,\); expected \(48,\)"),
        ({"regions": np.ones(48)}, "regions are of type float64; expected whole numbers"),
        ({"regions": np.full(48, -1)}, "regions go down to -1; expected labels from 0 up"),
        ({"regions": np.full(48, 4)}, "parameter 'stiffness_2' is not one of law 'neo_hookean'"),
        ({"parameters": block().parameters}, "a region needs 'stiffness_2'"),
        ({"regions": None}, "parameter 'stiffness_2' is not one of law 'neo_hookean'"),
        ({"law": find_law("neo_hookean_E_nu")}, "law 'neo_hookean_E_nu' says no shape_moduli"),
        (
            {"parameters": (*block().parameters, FACTORS[0]), "constants": {"stiffness_7": 0.0}},
            "parameter 'stiffness_7' is 0; it must be above 0",
        ),
    ],
)
def test_regions_that_do_not_fit(change, message):
    with pytest.raises(InputError, match=message) as caught:
        replace(halves(), **change)
    assert "\n" not in str(caught.value)


def test_the_fingerprint_sees_regions():
    scene = halves()
    swapped = replace(scene, regions=9 - scene.regions)
    assert len({block().fingerprint, scene.fingerprint, swapped.fingerprint}) == 3
    assert replace(scene, regions=scene.regions.astype(np.uint8)).fingerprint == scene.fingerprint
    with pytest.raises(ValueError, match="read-only"):
        scene.regions[0] = 7
