"""Kinds of systematic error in an experiment file, against the arrays they stand for."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

import calibrate as cal
from calibrate.model_error import ModelError, Systematic
from calibrate.model_error.kinds import Measurement, read_systematic, rotation_of
from calibrate.model_error.systematic import curve_correlation
from calibrate.statistical_model.errors import with_described_errors
from emulator.core.errors import InputError
from emulator.scenes import Scene
from linear_support import linear_forward
from scene_support import between_plates, block

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
    return read_systematic("e", description).systematic("e", Measurement(model.observe, data, {}))


def test_a_rigid_motion_turns_points_where_they_were_seen_or_at_rest(model, data):
    rest = model.observe.parts[A].points
    made = of(model, data, kind="rigid_motion", of=B, shift=0.5, turn=[1.0, 2.0, 0.0])
    expected = cal.model_error.rigid_motion("e", {B: rest + data[B]}, 0.5, (1.0, 2.0, 0.0))
    assert made.names == expected.names
    assert made.modes.keys() == {B}
    np.testing.assert_array_equal(made.modes[B], expected.modes[B])
    made = of(model, data, kind="rigid_motion", of="displacement", turn=1.0, at="rest")
    expected = cal.model_error.rigid_motion("e", {A: rest, B: rest}, 0.0, 1.0)
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
    np.testing.assert_allclose(rotation_of(rest, moved[A]), R, atol=1e-12)
    made = of(model, moved, kind="pins", of="displacement", sd=2.0)
    for k, axis in enumerate(np.eye(3)):
        expected = np.tile(2.0 * (R - np.eye(3)) @ axis, (3, 1))
        np.testing.assert_allclose(made.modes[A][k], expected, atol=1e-12)
    np.testing.assert_allclose(made.modes[B], 0.0, atol=1e-12)


def test_a_gain_is_one_factor_of_all_data(model, data):
    made = of(model, data, kind="gain", of="displacement", share=0.02)
    assert made.names == ("e",)
    for name in (A, B):
        np.testing.assert_array_equal(made.shares[name], np.full((1, 3, 3), 0.02))


def test_modes_are_rows_over_all_numbers_of_their_observations(model, data):
    rows = np.arange(36.0).reshape(2, 18)
    made = of(model, data, kind="modes", of=f"{A}+{B}", modes=rows.tolist())
    assert made.names == ("e 1", "e 2")
    np.testing.assert_array_equal(made.modes[A], rows[:, :9].reshape(2, 3, 3))
    np.testing.assert_array_equal(made.modes[B], rows[:, 9:].reshape(2, 3, 3))


def test_missing_values_are_left_out_of_the_modes(model, data):
    gappy = {A: data[A].copy(), B: data[B]}
    gappy[A][1, 2] = np.nan
    words = {"gain": {"kind": "gain", "of": "displacement", "share": 0.1}}
    found, present = with_described_errors(model, gappy, words)
    assert present[A].shape == (8,)
    shares = {A: np.full((1, 8), 0.1), B: np.full((1, 3, 3), 0.1)}
    by_hand = cal.with_systematic(model.given(gappy)[0], Systematic(("gain",), {}, shares=shares))
    draw = {"mu": jnp.asarray(3.0), "lam": jnp.asarray(4.0)}
    expected = by_hand.map_log_likelihood(draw, present)
    assert float(found.map_log_likelihood(draw, present)) == pytest.approx(float(expected))
    # What is left is taken as it is.
    assert found.given(present)[0] is found


def test_data_may_be_as_far_off_as_the_errors_are(model):
    far = {name: np.full((3, 3), 10.0) for name in (A, B)}
    checking = replace(model, check_scale=True)
    camera = {"kind": "rigid_motion", "of": "displacement", "shift": 10.0}
    found, present = with_described_errors(checking, far, {"camera": camera})
    found.check_data(present)
    little = {"camera": {**camera, "shift": 0.01}}
    found, present = with_described_errors(checking, far, little)
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
        ({"kind": "modes", "of": A, "modes": [[1.0]]}, "a row has 1 numbers; displacement@a has 9"),
        ({"kind": "modes", "of": A, "modes": []}, "modes: give one or more, of finite numbers"),
        ({"kind": "modes", "of": A, "modes": [["x"]]}, "modes"),
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
        with_described_errors(model, data, {"e": description})
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
        found, _ = with_described_errors(model, data, {"e": words})
        information = np.eye(count) / 1e-6
        means = {name: jnp.asarray(5.0) for name in data}
        left = found.error.information_left(information, 1.0, means)
        sds[count] = float(np.sum(left)) ** -0.5
    assert sds[10] == pytest.approx(0.2, rel=1e-3)
    assert sds[100] == pytest.approx(0.2, rel=1e-3)  # 1e-4 were they a hundred facts


def test_where_a_curve_is_must_be_known():
    model = forces(block(), 3)
    data = {name: np.array(5.0) for name in model.observe.parts}
    words = {"kind": "curve", "of": "parameter:lam", "along": "mu", "length": 0.1, "share": 0.1}
    with pytest.raises(InputError, match="along: 'mu' is not known; give its value as known"):
        with_described_errors(model, data, {"e": words})
    with pytest.raises(InputError, match="along: 'shear' is no parameter; there are mu, lam"):
        with_described_errors(model, data, {"e": {**words, "along": "shear"}})


def test_a_share_that_is_inferred_after_errors_of_known_sds_is_the_dense_covariance():
    """log N(y; g, W^-1 + V V^T + a^2 U U^T) at two sizes a, by map and by FEM; replicates have it."""
    model = forces(block(), 4, mu=True)
    values = np.array([4.0, 5.0, 5.5, 7.0])
    data = {name: np.array(v) for name, v in zip(model.observe.parts, values, strict=True)}
    curve = {"kind": "curve", "of": "parameter:lam", "along": "mu", "length": 0.4}
    words = {
        "gain": {"kind": "gain", "of": "parameter:lam", "share": 0.01},
        "law": {**curve, "share_scale": 0.3, "constant": 0.5},
    }
    found, present = with_described_errors(model, data, words)
    assert found.names == ("lam", "curve_share")
    at = 2.0 + np.arange(4) / 4
    predicted = np.full(4, 5.2)
    gain = 0.01 * predicted
    for share in (0.02, 0.2):
        law = share**2 * np.outer(predicted, predicted) * curve_correlation(at, 0.4, 0.5)
        C = 1e-6 * np.eye(4) + np.outer(gain, gain) + np.asarray(law)
        draw = {"lam": jnp.asarray(5.2), "curve_share": jnp.asarray(share)}
        expected = multivariate_normal(predicted, C).logpdf(values)
        assert float(found.map_log_likelihood(draw, present)) == pytest.approx(expected, rel=1e-6)
        means = {name: jnp.asarray(5.2) for name in data}
        by_fem = found.log_likelihood(draw, means, present)
        assert float(by_fem) == pytest.approx(expected, rel=1e-6)
        left = found.error.information_left(jnp.eye(4) / 1e-6, share, means)
        np.testing.assert_allclose(left, np.linalg.inv(C), rtol=1e-4, atol=1e-3)
    keys = jax.random.split(jax.random.key(0), 20_000)
    drawn = jax.vmap(
        lambda key: jnp.stack(list(found.means_with_errors(key, draw, means).values()))
    )(keys)
    np.testing.assert_allclose(np.cov(np.asarray(drawn).T), C - 1e-6 * np.eye(4), atol=0.1)
    # Kept and read again it is the same error.
    back = ModelError.restore(found.error.arrays(), found.error.words)
    assert back.fingerprint == found.error.fingerprint
    assert back.priors.keys() == {"curve_share"}
    with pytest.raises(InputError, match="the size 'curve_share' is inferred"):
        found.error.unknowns(present)


def test_curves_tell_the_share_that_a_law_is_off_by():
    """Eight numbers far apart along a curve: the share is the scatter of them, its sd 1 / sqrt(2 n)."""
    scene = block()
    names = [f"parameter:lam@{k}" for k in range(8)]
    model = cal.model(
        linear_forward(scene),
        dict.fromkeys(names, cal.MeasuredParameter(scene, "lam")),
        cal.GaussianNoise(sd=1e-3),
        known={f"mu@{k}": 2.0 + 100.0 * k for k in range(8)},
        check_scale=False,
    )
    values = 5.0 * (1.0 + 0.1 * np.random.default_rng(1).normal(size=8))
    data = {name: np.array(v) for name, v in zip(names, values, strict=True)}
    curve = {"kind": "curve", "of": "parameter:lam", "along": "mu", "length": 1.0}
    found, present = with_described_errors(model, data, {"e": {**curve, "share_scale": 0.3}})
    posterior = cal.sample(found, present, sampler="laplace", seed=1, predictions=False)
    row, scatter = posterior.summary()["curve_share"], float(np.std(values / values.mean()))
    assert abs(row["mean"] - scatter) < 1.5 * row["sd"]
    assert row["sd"] == pytest.approx(scatter / 4.0, rel=0.6)


def test_one_share_is_inferred_and_not_beside_a_known_one():
    model = forces(block(), 3, mu=True)
    data = {name: np.array(5.0) for name in model.observe.parts}
    curve = {"kind": "curve", "of": "parameter:lam", "along": "mu", "length": 0.4}
    with pytest.raises(InputError, match="share_scale is beside share or sd; give one of them"):
        with_described_errors(model, data, {"e": {**curve, "share_scale": 0.3, "share": 0.1}})
    with pytest.raises(InputError, match=r"share_scale is -0.3; it must be above 0"):
        with_described_errors(model, data, {"e": {**curve, "share_scale": -0.3}})
    two = {"a": {**curve, "share_scale": 0.3}, "b": {**curve, "share_scale": 0.2}}
    with pytest.raises(InputError, match="only one size can be unknown, by one name and sc"):
        with_described_errors(model, data, two)


def scale(count: int, sd: float):
    """A model whose ``count`` numbers are all lam."""
    scene = block()
    names = [f"parameter:lam@{k}" for k in range(count)]
    return cal.model(
        linear_forward(scene),
        dict.fromkeys(names, cal.MeasuredParameter(scene, "lam")),
        cal.GaussianNoise(sd=sd),
        known={f"mu@{k}": 2.0 + k for k in range(count)},
        check_scale=False,
    )


@pytest.mark.parametrize(
    "words",
    [
        {"kind": "gain", "of": "parameter:lam", "share": 0.1},
        pytest.param(
            {"kind": "curve", "of": "parameter:lam", "along": "mu", "length": 1e4, "share": 0.1},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_scale_of_sixty_numbers_is_not_fitted_too_low(words):
    """Peelle's puzzle: with shares of the data the mean is below 50 where they scatter about 75."""
    model = scale(60, 1.5)
    rng = np.random.default_rng(0)
    data = {name: np.array(75.0 + 1.5 * rng.normal()) for name in model.observe.parts}
    found, present = with_described_errors(model, data, {"e": words})

    def density(lam):
        return found.map_log_likelihood({"lam": lam}, present)

    grid = jnp.linspace(40.0, 120.0, 401)
    log_weight = np.asarray(jax.jit(lambda x: jax.lax.map(density, x))(grid))
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean = float(weight @ grid)
    sd = float(np.sqrt(weight @ (grid - mean) ** 2))
    # A tenth of lam, and somewhat above since larger predictions err more.
    assert mean == pytest.approx(75.0, rel=0.03)
    assert sd == pytest.approx(7.5, rel=0.1)


def test_intervals_hold_the_truth_of_data_with_a_gain():
    """The model's own data: posteriors of 300 sets, ranks of the truth uniform."""
    model, rng = scale(20, 1.0), np.random.default_rng(1)
    words = {"e": {"kind": "gain", "of": "parameter:lam", "share": 0.1}}
    grid = jnp.linspace(30.0, 200.0, 341)
    inside, low = 0, 0
    found, _ = with_described_errors(model, {n: np.array(75.0) for n in model.observe.parts}, words)

    @jax.jit
    def densities(values):
        data = dict(zip(model.observe.parts, values, strict=True))
        return jax.lax.map(lambda lam: found.map_log_likelihood({"lam": lam}, data), grid)

    for _ in range(300):
        truth = 75.0 * np.exp(0.2 * rng.normal())
        values = truth * (1.0 + 0.1 * rng.normal()) + rng.normal(size=20)
        log_weight = np.asarray(densities(values)) - np.log(grid)
        log_weight -= 0.5 * (np.log(grid / 75.0) / 0.2) ** 2
        weight = np.exp(log_weight - log_weight.max())
        rank = float(weight[grid < truth].sum() / weight.sum())
        inside, low = inside + (0.05 <= rank <= 0.95), low + (rank < 0.5)
    assert 255 <= inside <= 285
    assert 125 <= low <= 175


def test_a_posterior_kept_with_shares_of_data_is_refused_in_one_line(model, data):
    """Of a gain nothing in its arrays says what it is a share of; what was kept says it now."""
    words = {"e": {"kind": "gain", "of": "displacement", "share": 0.1}}
    error = with_described_errors(model, data, words)[0].error
    assert ModelError.restore(error.arrays(), error.words).fingerprint == error.fingerprint
    old = {name: value for name, value in error.words.items() if name != "shares"}
    with pytest.raises(InputError, match="older than systematic errors that are shares of pred"):
        ModelError.restore(error.arrays(), old)


@pytest.fixture(scope="module")
def frames():
    """Three nodes of a block in the plane, in three states of a plate that moves."""
    scene = between_plates()
    seen = cal.nodal_displacements(scene, [30, 41, 52])
    names = [f"displacement@{k}" for k in range(3)]
    known = {f"shear@{k}": amount for k, amount in enumerate((0.1, 0.2, 0.4))}
    known |= {f"stretch@{k}": 0.0 for k in range(3)}
    rng = np.random.default_rng(2)
    data = {name: 0.1 * rng.normal(size=(3, 3)) for name in names}
    for values in data.values():
        values[:, 2] = np.nan  # a camera sees the plane
    model = cal.model(
        linear_forward(scene), dict.fromkeys(names, seen), cal.GaussianNoise(sd=0.02),
        known=known, check_scale=False,
    )  # fmt: skip
    return model, data


@pytest.mark.parametrize("along", [None, 0.15])
@pytest.mark.parametrize("inferred", [False, True])
def test_an_error_of_a_field_has_the_covariance_it_is_declared_with(frames, along, inferred):
    model, data = frames
    size = {"sd_scale": 0.2} if inferred else {"sd": 0.05}
    field = {"kind": "field", "of": "displacement", "along": "shear", "length": 1.5, "share": 0.0}
    given, present = with_described_errors(
        model,
        data,
        {"dic": {**field, **size, **({} if along is None else {"along_length": along})}},
    )
    points, amounts = model.observe.parts["displacement@0"].points, np.array([0.1, 0.2, 0.4])

    def matern(distance, length):
        return (1.0 + np.sqrt(3.0) * distance / length) * np.exp(-np.sqrt(3.0) * distance / length)

    in_space = matern(np.linalg.norm(points[:, None] - points[None], axis=2), 1.5)
    in_time = np.outer(amounts, amounts) / 0.16
    if along is not None:
        in_time *= matern(np.abs(amounts[:, None] - amounts[None]), along)
    # Both components of the plane err alike, and not together.
    covariance = 0.05**2 * np.kron(in_time, np.kron(in_space, np.eye(2))) + 0.02**2 * np.eye(18)
    draw = {"mu": 3.0} | ({"field_sd": 0.05} if inferred else {})
    assert set(given.names) == set(draw)
    means, _ = given.predict(draw)
    residual = np.concatenate([np.asarray(present[n] - means[n]) for n in sorted(present)])
    expected = multivariate_normal(np.zeros(18), covariance).logpdf(residual)
    # Matern's correlation without its smallest modes: the sum is cut at 1e-8 of the largest.
    assert float(given.map_log_likelihood(draw, present)) == pytest.approx(expected, rel=1e-6)


def test_a_share_of_the_variance_may_be_left_out(frames):
    model, data = frames
    field = {"kind": "field", "of": "displacement", "along": "shear", "length": 1.5, "sd": 0.05}
    sizes = {}
    for share in (0.0, 0.4):
        given, _ = with_described_errors(model, data, {"dic": {**field, "share": share}})
        modes = given.error.terms[0].modes
        sizes[share] = len(modes), float(np.sum(modes**2))
    assert sizes[0.4][0] < sizes[0.0][0]
    assert 0.6 <= sizes[0.4][1] / sizes[0.0][1] < 1.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sd": None}, "give either sd"),
        ({"length": -1.0}, "length is -1.0"),
        ({"along_length": 0.0}, "along_length is 0.0"),
        ({"share": 1.0}, "share is 1.0"),
        ({"along": "mu"}, "'mu' is not known"),
        ({"along": "stretch"}, "'stretch' is 0 in every state"),
        ({"along": "none"}, "'none' is no parameter"),
    ],
)
def test_a_field_that_cannot_be_is_refused_in_a_line(frames, change, words):
    model, data = frames
    field = {"kind": "field", "of": "displacement", "along": "shear", "length": 1.5, "sd": 0.05}
    entries = {k: v for k, v in {**field, **change}.items() if v is not None}
    with pytest.raises(InputError, match=words) as error:
        with_described_errors(model, data, {"dic": entries})
    assert "\n" not in str(error.value)
