"""A cavity's volume over the range of its pressure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from calibrate.measurements.collection import observations
from calibrate.measurements.displacements import nodal_displacements
from calibrate.measurements.volume import CavityVolume, pressure_volume
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.taylor import Expansion
from linear_support import linear_forward


def test_each_volume_is_that_of_the_cavity_at_its_pressure(ventricle):
    forward = linear_forward(ventricle)
    curve = pressure_volume(forward)
    column = ventricle.parameter_names.index("pressure")
    pressure = ventricle.parameters[column]
    assert (curve.pressures[0], curve.pressures[-1]) == (pressure.low, pressure.high)
    volume, theta = CavityVolume(ventricle), ventricle.centre
    expected = [
        volume(forward(theta.at[column].set(p))[volume.nodes], theta) for p in curve.pressures
    ]
    assert np.ptp(expected) > 0.0
    np.testing.assert_allclose(curve.volumes(theta), expected, rtol=1e-12)
    # The pressure in theta is replaced.
    other = theta.at[column].set(pressure.high)
    np.testing.assert_allclose(curve.volumes(other), expected, rtol=1e-12)


def test_a_body_without_a_cavity_has_no_curve(beam):
    assert pressure_volume(linear_forward(beam)) is None


def of_random_modes(scene, count):
    """An emulator whose modes are random, and its coefficients products of two parameters."""
    rng, p = np.random.default_rng(0), len(scene.parameters)
    pairs = np.column_stack(np.tril_indices(p))[:count]
    fields = rng.normal(size=(1 + len(pairs), *scene.mesh.nodes.shape))
    series = Expansion(
        np.full(p, 0.5), jnp.asarray(fields[0]), pairs, jnp.asarray(4.0 * fields[1:])
    )
    return Emulator(scene, taylor=series).cache()


@pytest.mark.parametrize("order", [1, 2])
def test_the_volume_of_modes_is_that_of_the_wall_with_its_slopes(order):
    scene = em.scenes.left_ventricle(rings=4, around=8, layers=1, order=order)
    forward, volume = of_random_modes(scene, 10), CavityVolume(scene)
    by_modes, wall = volume.through(forward), forward.at(volume.nodes)

    def by_wall(theta):
        return volume(wall(theta), theta)

    thetas = scene.from_unit(jnp.asarray(np.random.default_rng(1).uniform(size=(3, 5))))
    for of in (lambda f: f, jax.grad, jax.hessian):
        expected = jax.vmap(of(by_wall))(thetas)
        np.testing.assert_allclose(
            jax.vmap(of(by_modes))(thetas), expected, rtol=0.0, atol=1e-12 * np.abs(expected).max()
        )
    np.testing.assert_allclose(
        jax.jacfwd(by_modes)(thetas[0]), jax.jacfwd(by_wall)(thetas[0]), rtol=1e-9
    )


def test_landmarks_and_volume_of_a_sum_of_modes_decode_no_wall(ventricle):
    forward, volume = of_random_modes(ventricle, 4), CavityVolume(ventricle)
    observe = observations({"points": nodal_displacements(ventricle, [3, 5]), "volume": volume})
    through = observe.through(forward)
    theta = ventricle.centre[None] * 1.01
    data, valid = through(theta)
    expected = observe(forward.at(observe.nodes)(theta), theta)
    assert valid
    for name in expected:
        np.testing.assert_allclose(data[name], expected[name], rtol=1e-12)
    sizes = [np.shape(c) for c in jax.make_jaxpr(lambda t: through(t)[0])(theta).consts]
    wall = 3 * len(volume.nodes)
    assert max(max(size, default=0) for size in sizes) < wall
    outside, valid = through(ventricle.centre[None] + 1e3)
    assert not valid
    assert float(outside["volume"]) == 0.0


def test_where_modes_have_more_pairs_than_the_wall_has_displacements_it_is_integrated(ventricle):
    volume = CavityVolume(ventricle)
    assert volume.through(linear_forward(ventricle)) is None
    many = int((6 * len(volume.nodes)) ** 0.5) + 1
    rng, p = np.random.default_rng(0), len(ventricle.parameters)
    terms = np.zeros((many, 1), dtype=int)
    modes = jnp.asarray(rng.normal(size=(many, *ventricle.mesh.nodes.shape)))
    series = Expansion(np.full(p, 0.5), modes[0], terms, modes)
    assert volume.through(Emulator(ventricle, taylor=series).cache()) is None
