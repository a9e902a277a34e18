from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sparsax

import emulator as em
from emulator.core.errors import InputError, SolverError
from emulator.scenes import Parameter
from emulator.scenes.loads import FollowerPressure, Gravity
from emulator.surrogates import taylor
from emulator.surrogates.taylor import Expansion, constant, expand, expand_at, monomials
from emulator.verify.consistency import block as heavy_block
from scene_support import block, slope


def pressed():
    """A pressure that follows an open face: no potential, and a tangent that is not symmetric."""
    pressure = Parameter("pressure", "kPa", 0.2, 0.6)
    scene = block(cells=(2, 1, 1))
    parameters, loads = (scene.parameters[0], pressure), (FollowerPressure("right"),)
    return replace(scene, loads=loads, parameters=parameters, constants={"lam": 4.0})


def imaged():
    """The same body, its mesh that of an image: unloaded, and loaded again."""
    scene = pressed()
    constants = {**scene.constants, "imaged": 0.3}
    return replace(scene, loaded_by={"pressure": "imaged"}, constants=constants)


def halves():
    """Two regions, each with a factor of its own."""
    scene = block(loads=(Gravity(density=500.0),), cells=(2, 1, 1))
    left = scene.mesh.nodes[scene.mesh.elements].mean(axis=1)[:, 0] < 1.0
    factors = (
        Parameter("stiffness_1", "", 0.5, 2.0, "log"),
        Parameter("stiffness_2", "", 0.5, 2.0),
    )
    constants = {"mu": 3.0, "lam": 4.0}
    return replace(scene, regions=np.where(left, 1, 2), parameters=factors, constants=constants)


SCENES = {
    "gravity": lambda: em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1),
    "a face moved": lambda: em.scenes.twisting_cube(cells=2, order=1),
    "regions": halves,
    "quadratic": lambda: heavy_block("P2"),
    "mean dilatation": lambda: heavy_block("P2, mean dilatation"),
    "follower pressure": pressed,
    "a loaded mesh": imaged,
}


def truncated(series: Expansion, order: int) -> Expansion:
    kept = np.sum(series.indices >= 0, axis=1) <= order
    return replace(series, indices=series.indices[kept], derivatives=series.derivatives[kept])


def orders(simulator, series, directions, steps):
    """Measured order of the error in the step, of the series cut after 1, 2, ..."""
    left = []
    for h in steps:
        x = series.centre + h * directions
        u = simulator.solve(
            simulator.scene.from_unit(jnp.asarray(x)), series(x)
        ).require_converged()
        cuts = [truncated(series, k) for k in range(1, series.order + 1)]
        left.append([np.abs(u.displacement - cut(x)).max() for cut in cuts])
    return [slope(steps, errors) for errors in np.array(left).T]


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(
            k,
            marks=pytest.mark.slow if k != "gravity" else [],
        )
        for k in SCENES
    ],
)
def test_the_error_against_fem_is_of_one_order_more(kind):
    scene = SCENES[kind]()
    simulator = em.Simulator(scene)
    order = 3 if kind in ("gravity", "follower pressure") else 2
    series = expand(simulator, order=order)
    assert series.order == order
    assert len(series.indices) == (2 + 3 + 4 if order == 3 else 2 + 3)
    found = orders(simulator, series, np.array([0.8, -0.6]), 0.16 / 2.0 ** np.arange(3))
    np.testing.assert_allclose(found, [2.0, 3.0, 4.0][:order], atol=0.25)
    np.testing.assert_array_equal(np.asarray(series.derivatives)[:, scene.held], 0.0)
    first = simulator.sensitivities(series.displacement, scene.centre)
    scales = jnp.diagonal(jax.jacfwd(scene.from_unit)(jnp.full(2, 0.5)))
    atol = 1e-10 * float(jnp.abs(first).max())
    np.testing.assert_allclose(series.derivatives[:2], first * scales[:, None, None], atol=atol)


@pytest.fixture(scope="module")
def ventricle():
    return em.Simulator(em.scenes.left_ventricle(rings=3, around=6, layers=1, order=1))


@pytest.fixture(scope="module")
def second(ventricle):
    return expand(ventricle, order=2)


@pytest.mark.slow
def test_second_derivatives_against_differences_of_sensitivities(ventricle, second):
    """On a ventricle, the pressure among its five parameters."""
    scene = ventricle.scene
    scales = jax.vmap(lambda x: jnp.diagonal(jax.jacfwd(scene.from_unit)(x)))

    def slopes(x):
        u = ventricle(scene.from_unit(x))
        return ventricle.sensitivities(u, scene.from_unit(x)) * scales(x[None])[0][:, None, None]

    rows = {tuple(index.tolist()): k for k, index in enumerate(second.indices)}
    largest = float(jnp.abs(second.derivatives[5:]).max())
    for a in (0, 4):
        step = 1e-3 * jnp.eye(5)[a]
        central = (slopes(0.5 + step) - slopes(0.5 - step)) / 2e-3
        for b in range(5):
            ours = second.derivatives[rows[tuple(sorted((a, b)))]]
            np.testing.assert_allclose(ours, central[b], atol=1e-4 * largest)


def test_one_factor_serves_every_order(simulator):
    theta = simulator.scene.from_unit(jnp.full(2, 0.45))
    u = simulator(theta)
    before = sparsax.factorization_count()
    expand_at(simulator, u, theta, 3)
    assert sparsax.factorization_count() <= before + 1


def test_monomials_by_hand():
    indices = np.array([[0, -1, -1], [1, -1, -1], [0, 0, -1], [0, 1, -1], [1, 1, 1], [0, 0, 1]])
    step = jnp.array([[2.0, 3.0], [0.0, -1.0]])
    expected = [[2.0, 3.0, 2.0, 6.0, 4.5, 6.0], [0.0, -1.0, 0.0, 0.0, -1.0 / 6.0, 0.0]]
    np.testing.assert_allclose(monomials(indices, step), expected, rtol=1e-15)
    at = lambda s: monomials(indices, s)
    np.testing.assert_allclose(jax.jacfwd(at)(jnp.zeros(2))[:2], np.eye(2))
    curvature = jax.hessian(at)(jnp.zeros(2))  # where every factor of the products is zero
    np.testing.assert_allclose(curvature[2], [[1.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(curvature[3], [[0.0, 1.0], [1.0, 0.0]])
    np.testing.assert_allclose(curvature[4:], 0.0)


def test_the_series_is_a_polynomial_of_its_terms():
    rng = np.random.default_rng(0)
    u, terms = rng.normal(size=(4, 3)), rng.normal(size=(5, 4, 3))
    indices = np.array([[0, -1], [1, -1], [0, 0], [0, 1], [1, 1]])
    series = Expansion(np.array([0.5, 0.25]), jnp.asarray(u), indices, jnp.asarray(terms))
    (a, b), d = (0.2, -0.4), terms
    by_hand = u + a * d[0] + b * d[1] + 0.5 * a * a * d[2] + a * b * d[3] + 0.5 * b * b * d[4]
    x = jnp.array([0.7, -0.15])
    np.testing.assert_allclose(series(x), by_hand, rtol=1e-13)
    np.testing.assert_allclose(jax.jit(jax.vmap(series))(jnp.stack([x, x]))[1], series(x))
    np.testing.assert_allclose(series(jnp.stack([x, x]))[1], by_hand, rtol=1e-13)


def test_a_constant_is_the_series_of_order_zero():
    u = jnp.arange(12.0).reshape(4, 3)
    series = constant(np.full(2, 0.5), u)
    assert series.order == 0
    np.testing.assert_array_equal(series(jnp.array([0.1, 0.9])), u)
    np.testing.assert_array_equal(jax.jacfwd(series)(jnp.array([0.1, 0.9])), 0.0)
    assert series.monomials(jnp.zeros((7, 2))).shape == (7, 0)


@pytest.mark.slow
def test_one_parameter():
    scene = block(loads=(Gravity(density=300.0),), cells=(1, 1, 1))
    scene = replace(scene, parameters=scene.parameters[:1], constants={"lam": 4.0})
    series = expand(em.Simulator(scene), order=2)
    np.testing.assert_array_equal(series.indices, [[0, -1], [0, 0]])


def test_an_order_of_too_many_terms_ends_the_series(simulator, monkeypatch):
    u = simulator(simulator.scene.centre)
    for limit, order, count in ((2, 1, 2), (1, 0, 0)):  # 2 first and 3 second derivatives
        monkeypatch.setattr(taylor, "_MOST_TERMS", limit)
        series = expand_at(simulator, u, simulator.scene.centre, 3)
        assert series.order == order
        assert len(series.derivatives) == count
        assert jnp.isfinite(series(jnp.full(2, 0.6))).all()


def test_refusals(simulator, monkeypatch):
    scene = simulator.scene
    for order in (0, 5, 2.5):
        with pytest.raises(InputError, match=f"expansion of order {order}; give 1 to 4"):
            expand(simulator, order=order)
        with pytest.raises(InputError, match=f"expansion of order {order}; give 1 to 4"):
            expand_at(simulator, simulator.rest, scene.centre, order)
    with pytest.raises(InputError, match=r"theta has shape \(1,\); expected \(2,\)"):
        expand(simulator, scene.centre[:1])
    brief = replace(simulator, options=em.fem.NewtonOptions(max_iterations=1))
    with pytest.raises(SolverError, match="the expansion's centre: "):
        expand(brief)
    u = simulator(scene.centre)
    with pytest.raises(SolverError, match="derivatives of order 1 in theta are not finite"):
        expand_at(simulator, u, scene.centre.at[0].set(jnp.nan), 1)
