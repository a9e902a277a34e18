from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem import run_campaign, sobol
from emulator.scenes.loads import Gravity
from emulator.surrogates.discrepancy import fit_discrepancy, maximin_subset
from emulator.surrogates.pod_gp import fit_reduced
from emulator.surrogates.taylor import constant, expand
from scene_support import block


@pytest.fixture(scope="module")
def simulator():
    """A soft block over a box of a factor of ten, so that a stationary kernel has a hard time."""
    return em.Simulator(block(loads=(Gravity(density=150.0),), cells=(2, 1, 1)))


@pytest.fixture(scope="module")
def series(simulator):
    return expand(simulator, order=2)


@pytest.fixture(scope="module")
def runs(simulator):
    return run_campaign(simulator, sobol(simulator.scene, 6, seed=0), sensitivities=True)


@pytest.fixture(scope="module")
def fitted(simulator, runs, series):
    return fit_discrepancy(simulator.scene, runs, series)


def test_it_meets_its_runs_and_their_sensitivities(simulator, runs, series, fitted):
    above = fit_discrepancy(simulator.scene, runs, series, series)
    scene = simulator.scene

    def sampled(field):
        """Its values and slopes, as one program."""
        return jax.jit(lambda x: (field(x), jax.jacfwd(field)(x)))

    both = sampled(fitted), sampled(lambda x: series(x) + above(x))
    largest = np.abs(runs.displacement).max()
    given = runs.sensitivities * scene.space.rates(runs.theta)[..., None, None]
    for x, u, slopes in zip(scene.to_unit(runs.theta), runs.displacement, given, strict=True):
        for value, found in (field(x) for field in both):
            np.testing.assert_allclose(value, u, atol=1e-5 * largest)
            np.testing.assert_allclose(np.moveaxis(found, -1, 0), slopes, atol=1e-4 * largest)


@pytest.mark.slow
def test_better_than_values_alone(beam):
    """From six runs, ten times closer than POD with Gaussian processes (measured: a hundred)."""
    simulator = em.Simulator(beam)
    runs = run_campaign(simulator, sobol(beam, 6, seed=0), sensitivities=True)
    fitted = fit_discrepancy(beam, runs, expand(simulator, order=2))
    tests, reduced = run_campaign(simulator, sobol(beam, 12, seed=9)), fit_reduced(beam, runs)
    far = lambda u, exact: np.median(np.linalg.norm(u - exact, axis=-1))
    ours, theirs = [], []
    for theta, u in zip(tests.theta, tests.displacement, strict=True):
        ours.append(far(fitted(beam.to_unit(theta)), u))
        theirs.append(far(reduced(theta), u))
    assert 10.0 * np.median(ours) < np.median(theirs)


def test_the_same_twice_to_the_bit(simulator, runs, series, fitted):
    again = fit_discrepancy(simulator.scene, runs, series)
    for name in ("known", "value_weights", "derivative_weights", "offset", "modes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fitted, name))


def test_inside_jit_vmap_and_grad(fitted):
    xs = jnp.array([[0.3, 0.8], [0.5, 0.5], [1.1, -0.1]])
    many = jax.jit(jax.vmap(fitted))(xs)
    np.testing.assert_allclose(many, [fitted(x) for x in xs], rtol=1e-10, atol=1e-12)
    f = jax.jit(lambda x: jnp.sum(fitted(x) ** 2))
    x, h = xs[0], 1e-5
    central = [(f(x + h * e) - f(x - h * e)) / (2 * h) for e in jnp.eye(2)]
    np.testing.assert_allclose(jax.grad(f)(x), central, rtol=1e-6)
    assert jnp.isfinite(jax.hessian(f)(jnp.full(2, 0.5))).all()  # the series' centre


def test_an_expansion_of_order_zero_leaves_the_position_alone(simulator, runs):
    scene = simulator.scene
    plain = fit_discrepancy(scene, runs, constant(np.full(2, 0.5), runs.displacement[0]))
    assert plain.known.shape == (6, 2)
    x = scene.to_unit(runs.theta)[3]
    np.testing.assert_allclose(plain(x), runs.displacement[3], atol=1e-4)


@pytest.mark.slow
def test_one_parameter_two_runs():
    scene = block(loads=(Gravity(density=150.0),), cells=(1, 1, 1))
    scene = replace(scene, parameters=scene.parameters[:1], constants={"lam": 4.0})
    simulator = em.Simulator(scene)
    runs = run_campaign(simulator, jnp.array([[2.0], [7.0]]), sensitivities=True)
    fitted = fit_discrepancy(scene, runs, expand(simulator, order=1))
    for theta, u in zip(runs.theta, runs.displacement, strict=True):
        np.testing.assert_allclose(fitted(scene.to_unit(theta)), u, atol=1e-6)


@pytest.mark.slow
def test_equal_runs_count_once(simulator, runs, series):
    twice = runs.take(np.array([0, 1, 2, 0]))
    fitted = fit_discrepancy(simulator.scene, twice, series)
    x = simulator.scene.to_unit(runs.theta)
    np.testing.assert_allclose(fitted(x[0]), runs.displacement[0], atol=1e-4)
    same = fit_discrepancy(simulator.scene, runs.take(np.array([4, 4])), series)
    np.testing.assert_allclose(same(x[4]), runs.displacement[4], atol=1e-4)
    assert jnp.isfinite(same(x[0])).all()


def test_a_maximin_subset_is_far_apart_and_never_twice_the_same():
    line = np.array([0.0, 0.1, 1.0, 0.5, 1.0])[:, None]
    np.testing.assert_array_equal(maximin_subset(line, 3), [0, 2, 3])
    np.testing.assert_array_equal(maximin_subset(line, 9), [0, 2, 3, 1])


def test_refusals(simulator, runs, series):
    def refused(message, some=runs, expansion=series, mean_map=None):
        with pytest.raises(InputError, match=message):
            fit_discrepancy(simulator.scene, some, expansion, mean_map)

    refused("FEM runs with sensitivities; these 6 have none", runs._replace(sensitivities=None))
    refused("needs 2 FEM runs or more; there is 1", runs.take(slice(1)))
    for name in ("theta", "displacement", "sensitivities"):
        column = getattr(runs, name)
        lost = runs._replace(**{name: column.at[(2,) + (0,) * (column.ndim - 1)].set(jnp.nan)})
        refused(f"FEM run 2: {name} not finite", lost)
    refused(
        "has 2 parameters; the expansion is in 3", runs, constant(np.zeros(3), series.displacement)
    )
    nothing = runs._replace(
        displacement=jnp.ones_like(runs.displacement),
        sensitivities=jnp.zeros_like(runs.sensitivities),
    )
    refused("nothing to fit: the map meets every FEM run", nothing, series)
    refused("a map that is finite at every FEM run", runs, series, lambda x: jnp.nan * series(x))


def test_points_that_are_known_are_no_farthest_ones():
    rows = maximin_subset(np.zeros((3, 2)), 2, np.zeros((1, 2)))
    assert rows.dtype.kind == "i"
    assert rows.size == 0
