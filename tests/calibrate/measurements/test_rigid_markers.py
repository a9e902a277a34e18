"""Markers on pins against rotations by matrices and scipy's polar decomposition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import polar

from calibrate.measurements import (
    observations,
    observations_from_json,
    parse_observation,
    rigid_markers,
)
from calibrate.measurements.data import read_measurements, write_data
from emulator.core.errors import InputError
from emulator.scenes.supports import Support
from scene_support import between_plates, block, rotation

PINS = np.array([[6.0, 1.0, 1.0], [5.0, -2.0, 3.0], [7.0, 4.0, 5.0]])


@pytest.fixture(params=["linear", "quadratic"])
def scene(request):
    return (
        block()
        if request.param == "linear"
        else between_plates(
            supports=(Support("bottom"),), parameters=between_plates().parameters[:1]
        )
    )


def seen(observe, u):
    return np.asarray(observe(jnp.asarray(u)[..., observe.nodes, :], None))


def test_rigid_motions_carry_markers(scene):
    R, shift = rotation(3), np.array([1.0, -2.0, 0.5])
    moved = scene.mesh.nodes @ R.T + shift - scene.mesh.nodes
    found = seen(rigid_markers(scene, "right", PINS), np.stack([0.0 * moved, moved]))
    np.testing.assert_allclose(found[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(found[1], PINS @ R.T + shift - PINS, atol=1e-12)


def test_of_a_strained_face_the_nearest_rotation(scene):
    """Of an affine motion, of its directions in the plane alone."""
    F = np.eye(3) + 0.2 * np.random.default_rng(0).normal(size=(3, 3))
    observe = rigid_markers(scene, "right", PINS)
    moved = scene.mesh.nodes @ (F - np.eye(3)).T
    e = observe.axes
    Q, _ = polar(F @ e[:2].T)
    R = np.column_stack([Q, np.cross(Q[:, 0], Q[:, 1])]) @ e
    expected = F @ observe.mean + (PINS - observe.mean) @ R.T - PINS
    np.testing.assert_allclose(seen(observe, moved), expected, atol=1e-12)


def test_its_derivative_is_a_central_difference(scene):
    observe = rigid_markers(scene, "right", PINS)
    rng = np.random.default_rng(1)
    u, along = 0.2 * rng.normal(size=(2, len(observe.nodes), 3))
    _, slope = jax.jvp(lambda v: observe(v, None), (jnp.asarray(u),), (jnp.asarray(along),))
    h = 1e-5
    by_differences = (observe(u + h * along, None) - observe(u - h * along, None)) / (2.0 * h)
    np.testing.assert_allclose(slope, by_differences, atol=1e-8)


def test_from_files_and_back(scene, tmp_path):
    observe = observations({"markers:right@a": rigid_markers(scene, "right", PINS)})
    data = {"markers:right@a": np.arange(9.0).reshape(3, 3)}
    for file in ("d.csv", "d.nc"):
        write_data(tmp_path / file, observe, data)
        back, values = read_measurements(scene, tmp_path / file)[:2]
        np.testing.assert_array_equal(values["markers:right@a"], data["markers:right@a"])
        np.testing.assert_array_equal(back.parts["markers:right@a"].points, PINS)
    again = observations_from_json(scene, observe.to_json())
    np.testing.assert_array_equal(again.nodes, observe.nodes)


@pytest.mark.parametrize(
    ("facet_set", "points", "said"),
    [
        ("rihgt", PINS, "facet set 'rihgt'"),
        ("right", PINS[:, :2], "markers have shape"),
        ("right", PINS[[0, 0]], "markers 0 and 1 are both at"),
        ("right", PINS * 100.0, "marker 2 at .* stands .* mm away from a body of"),
    ],
)
def test_markers_that_cannot_be(scene, facet_set, points, said):
    with pytest.raises(InputError, match=said):
        rigid_markers(scene, facet_set, points)


def test_pins_are_not_drawn(scene):
    with pytest.raises(InputError, match="markers stand where they were put; give their positions"):
        parse_observation(scene, "markers:right:4")
