"""Systematic errors in words, against the arrays they stand for."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibrate as cal
from calibrate.statistical_model.shared_errors import (
    Seen,
    shared_error,
    turned,
    with_shared_errors,
)
from calibrate.statistical_model.systematic import Systematic
from emulator.errors import InputError
from emulator.scenes import Scene
from linear_support import linear_forward
from scene_support import block

NODES = [3, 11, 20]
A, B = "displacement@a", "displacement@b"


@pytest.fixture(scope="module")
def model():
    scene = block()
    seen = cal.nodal_displacements(scene, NODES)
    return cal.model(
        linear_forward(scene), {A: seen, B: seen}, cal.GaussianNoise(sd=0.1), check_scale=False
    )


@pytest.fixture(scope="module")
def data(model):
    rng = np.random.default_rng(0)
    return {name: 0.3 * rng.normal(size=(3, 3)) for name in (A, B)}


def of(model, data, **description):
    """The one error that a description makes."""
    return shared_error("e", description).systematic("e", Seen(model, data))


def test_a_rigid_motion_turns_points_where_they_were_seen_or_at_rest(model, data):
    rest = model.observe.parts[A].points
    made = of(model, data, kind="rigid_motion", of=B, shift=0.5, turn=[1.0, 2.0, 0.0])
    expected = cal.rigid_motion("e", {B: rest + data[B]}, 0.5, (1.0, 2.0, 0.0))
    assert made.names == expected.names
    assert made.modes.keys() == {B}
    np.testing.assert_array_equal(made.modes[B], expected.modes[B])
    made = of(model, data, kind="rigid_motion", of="displacement", turn=1.0, at="rest")
    expected = cal.rigid_motion("e", {A: rest, B: rest}, 0.0, 1.0)
    for name in (A, B):
        np.testing.assert_array_equal(made.modes[name], expected.modes[name])
    made = of(model, data, kind="rigid_motion", of=A, turn=1.0, at="rest", about=rest[1].tolist())
    np.testing.assert_array_equal(made.modes[A][:, 1], 0.0)


def test_a_placement_has_an_offset_for_the_rows_it_names(model, data):
    made = of(model, data, kind="placement", of=f"{A}+{B}", sd=0.7, rows=[1])
    assert made.names == ("e 1,0", "e 1,1", "e 1,2")
    for name in (A, B):
        np.testing.assert_array_equal(made.modes[name][:, 1], 0.7 * np.eye(3))
        np.testing.assert_array_equal(made.modes[name][:, [0, 2]], 0.0)


def test_pins_move_as_the_turn_of_their_surface_says(model):
    rest = model.observe.parts[A].points
    R = Rotation.from_rotvec([0.1, -0.3, 0.2]).as_matrix()
    moved = {A: rest @ R.T - rest + [1.0, 2.0, 3.0], B: np.zeros((3, 3))}
    np.testing.assert_allclose(turned(rest, moved[A]), R, atol=1e-12)
    made = of(model, moved, kind="pins", of="displacement", sd=2.0)
    for k, axis in enumerate(np.eye(3)):
        expected = np.tile(2.0 * (R - np.eye(3)) @ axis, (3, 1))
        np.testing.assert_allclose(made.modes[A][k], expected, atol=1e-12)
    np.testing.assert_allclose(made.modes[B], 0.0, atol=1e-12)


def test_a_gain_is_one_factor_of_all_data(model, data):
    made = of(model, data, kind="gain", of="displacement", share=0.02)
    assert made.names == ("e",)
    for name in (A, B):
        np.testing.assert_array_equal(made.modes[name], [0.02 * data[name]])


def test_missing_values_are_left_out_of_the_modes(model, data):
    gappy = {A: data[A].copy(), B: data[B]}
    gappy[A][1, 2] = np.nan
    words = {"gain": {"kind": "gain", "of": "displacement", "share": 0.1}}
    found, present = with_shared_errors(model, gappy, words)
    assert present[A].shape == (8,)
    kept = np.delete(0.1 * data[A].ravel(), 5)
    by_hand = cal.with_systematic(
        model.given(gappy)[0], Systematic(("gain",), {A: kept[None], B: 0.1 * data[B][None]})
    )
    draw = {"mu": jnp.asarray(3.0), "lam": jnp.asarray(4.0)}
    expected = by_hand.map_log_likelihood(draw, present)
    assert float(found.map_log_likelihood(draw, present)) == pytest.approx(float(expected))
    # What is left is taken as it is.
    assert found.given(present)[0] is found


def test_data_may_be_as_far_off_as_the_errors_are(model):
    far = {name: np.full((3, 3), 10.0) for name in (A, B)}
    checking = replace(model, check_scale=True)
    camera = {"kind": "rigid_motion", "of": "displacement", "shift": 10.0}
    found, present = with_shared_errors(checking, far, {"camera": camera})
    found.check_data(present)
    little = {"camera": {**camera, "shift": 0.01}}
    found, present = with_shared_errors(checking, far, little)
    with pytest.raises(InputError, match="larger than predicted"):
        found.check_data(present)


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ({"kind": "wind", "of": A}, "systematic 'e': kind 'wind' is unknown; known: rigid_motion"),
        ({"of": A}, "systematic 'e': key 'kind' is missing; give rigid_motion, placement"),
        ({"kind": "gain", "of": A}, "systematic 'e': key 'share' is missing"),
        ({"kind": "gain", "of": A, "share": "2 %"}, 'share = "2 %"; expected a number'),
        ({"kind": "gain", "of": A, "share": -0.1}, "share is -0.1; it must be 0 or more"),
        ({"kind": "gain", "of": A, "share": 0.1, "sd": 1.0}, "unknown key 'sd'; known: of, share"),
        ({"kind": "gain", "of": "volume", "share": 0.1}, "of: 'volume' is not observed; observed"),
        ({"kind": "placement", "of": A, "sd": 1.0, "rows": [3]}, "rows: there is no point 3"),
        ({"kind": "rigid_motion", "of": A, "turn": [1.0]}, "turn"),
        ({"kind": "rigid_motion", "of": A, "at": "sea"}, 'at = "sea"; expected "loaded" or "rest"'),
        (
            {"kind": "curve", "of": A, "along": "mu", "length": 0.1},
            "of: 'displacement@a' is not a single number",
        ),
        (
            {"kind": "curve", "of": A, "along": "mu", "length": 0.0},
            "length is 0.0; it must be abov",
        ),
        (
            {"kind": "curve", "of": A, "along": "mu", "length": 1.0, "constant": 2.0},
            "constant is 2.0; it is a part, 0 to 1",
        ),
    ],
)
def test_what_cannot_be_is_one_line(model, data, description, message):
    with pytest.raises(InputError) as told:
        with_shared_errors(model, data, {"e": description})
    assert message in str(told.value)
    assert str(told.value).startswith("systematic 'e'")
    assert "\n" not in str(told.value)


def forces(scene: Scene, count: int, **known):
    """A model of one number in each of ``count`` states, mu known there if at all."""
    number = cal.MeasuredParameter(scene, "lam")
    names = [f"parameter:lam@{k}" for k in range(count)]
    given = {f"mu@{k}": 2.0 + k / count for k in range(count)} if known.get("mu") else None
    return cal.model(
        linear_forward(scene), dict.fromkeys(names, number), cal.GaussianNoise(sd=1e-3), known=given
    )


def test_a_hundred_points_of_a_curve_are_not_a_hundred_facts():
    """The mean of what is measured stays as uncertain as the curve is, however many points."""
    sds = {}
    for count in (10, 100):
        model = forces(block(), count, mu=True)
        data = {name: np.array(5.0) for name in model.observe.parts}
        words = {
            "kind": "curve", "of": "parameter:lam", "along": "mu", "length": 1e3, "share": 0.04
        }  # fmt: skip
        found, _ = with_shared_errors(model, data, {"e": words})
        information = np.eye(count) / 1e-6
        left = found.error.information_left(information, jnp.ones(1))
        sds[count] = float(np.sum(left)) ** -0.5
    assert sds[10] == pytest.approx(0.2, rel=1e-3)
    assert sds[100] == pytest.approx(0.2, rel=1e-3)  # 1e-4 were they a hundred facts


def test_where_a_curve_is_must_be_known():
    model = forces(block(), 3)
    data = {name: np.array(5.0) for name in model.observe.parts}
    words = {"kind": "curve", "of": "parameter:lam", "along": "mu", "length": 0.1, "share": 0.1}
    with pytest.raises(InputError, match="along: 'mu' is not known; give its value as known"):
        with_shared_errors(model, data, {"e": words})
    with pytest.raises(InputError, match="along: 'shear' is no parameter; there are mu, lam"):
        with_shared_errors(model, data, {"e": {**words, "along": "shear"}})
