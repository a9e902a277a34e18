"""Lengths between landmarks, and parameters that were measured themselves."""

import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
from calibrate.measurements import (
    MeasuredParameter,
    length_between,
    observations,
    observations_from_json,
    parse_observation,
)
from calibrate.measurements.data import read_measurements, write_data
from calibrate.noise import CorrelatedNoise
from calibrate.project import Run
from emulator.core.errors import InputError
from linear_support import linear_forward


def seen(observe, u):
    return np.asarray(observe(jnp.asarray(u)[..., observe.nodes, :], None))


def test_lengths_between_all_sorts_of_landmarks(ventricle):
    rng = np.random.default_rng(0)
    nodes, u = ventricle.mesh.nodes, rng.normal(size=(2, *ventricle.mesh.nodes.shape))
    x = nodes + u
    base = x[:, ventricle.mesh.node_set("base")].mean(axis=1)
    apex = x[:, ventricle.mesh.node_set("apex_epicardium")[0]]
    inside = nodes[ventricle.mesh.elements[7]].mean(axis=0)
    moved = x[:, ventricle.mesh.elements[7]].mean(axis=1)
    for first, second, expected in (
        ("base", "apex_epicardium", base - apex),
        ("3", "14", x[:, 14] - x[:, 3]),
        (",".join(map(repr, inside.tolist())), "3", moved - x[:, 3]),
    ):
        found = seen(length_between(ventricle, first, second), u)
        np.testing.assert_allclose(found, np.linalg.norm(expected, axis=-1), rtol=1e-9)


def test_rigid_motions_keep_a_length_and_stretches_stretch_it(ventricle):
    observe = length_between(ventricle, "base", "apex_epicardium")
    at_rest = float(seen(observe, np.zeros_like(ventricle.mesh.nodes)))
    turned = ventricle.mesh.nodes[:, [1, 2, 0]] + [1.0, 2.0, 3.0]
    assert float(seen(observe, turned - ventricle.mesh.nodes)) == pytest.approx(at_rest)
    assert float(seen(observe, 0.1 * ventricle.mesh.nodes)) == pytest.approx(1.1 * at_rest)


def test_from_words_to_files_and_back(ventricle, tmp_path):
    words = "length:base:apex_epicardium+length:3:0.0,0.0,-60.0+parameter:pressure+volume"
    observe = parse_observation(ventricle, words)
    assert list(observe.parts) == words.split("+")
    data = dict(zip(observe.parts, map(np.asarray, (75.0, 12.5, 1.07, 120.0)), strict=True))
    for file in ("d.csv", "d.nc"):
        write_data(tmp_path / file, observe, data)
        back, values = read_measurements(ventricle, tmp_path / file)[:2]
        assert {k: float(v) for k, v in values.items()} == {k: float(v) for k, v in data.items()}
        np.testing.assert_array_equal(np.sort(back.nodes), np.sort(observe.nodes))
    again = observations_from_json(ventricle, observe.to_json())
    np.testing.assert_array_equal(again.nodes, observe.nodes)


def test_a_measured_pressure_is_data(ventricle):
    """The posterior of a Gaussian measurement under a flat prior, by densities."""
    forward = linear_forward(ventricle, size=1.0)
    observe = {
        "volume": cal.CavityVolume(ventricle),
        "parameter:pressure": MeasuredParameter(ventricle, "pressure"),
    }
    noise = {"volume": cal.GaussianNoise(sd=2.0), "parameter:pressure": cal.GaussianNoise(sd=0.1)}
    both, alone = cal.model(forward, observe, noise), cal.model(forward, {"volume": observe["volume"]}, noise["volume"])  # fmt: skip
    draw = {"a": 0.3, "b": 2.0, "a_f": 5.0, "b_f": 1.7, "pressure": 1.1}
    thetas = both.states.thetas(draw)
    means, _ = both.predict(draw)
    assert float(means["parameter:pressure"]) == 1.1
    data = both.check_data({"volume": means["volume"], "parameter:pressure": 1.25})

    def density(model, data):
        u = model.evaluate(thetas).displacement
        return float(model.log_density({}, model.observe(u, thetas), data))

    change = density(both, data) - density(alone, {"volume": data["volume"]})
    assert change == pytest.approx(-0.5 * 1.5**2 - np.log(0.1 * np.sqrt(2.0 * np.pi)))
    # It has a state like any other: each its own pressure.
    states = cal.model(
        forward,
        {f"{name}@{state}": part for name, part in observe.items() for state in ("low", "high")},
        noise,
    )
    means, _ = states.predict({**draw, "pressure@low": 0.6, "pressure@high": 1.2})
    assert float(means["parameter:pressure@low"]) == 0.6
    assert float(means["parameter:pressure@high"]) == 1.2


def test_volumes_and_pressures_of_frames_are_one_file(ventricle, tmp_path):
    text = "state,volume,parameter:pressure\nf1,110.2,0.61\nf2,124.9,1.18\n"
    (tmp_path / "frames.csv").write_text(text)
    observe, values = read_measurements(ventricle, tmp_path / "frames.csv")[:2]
    expected = {"volume@f1": 110.2, "parameter:pressure@f1": 0.61, "volume@f2": 124.9, "parameter:pressure@f2": 1.18}  # fmt: skip
    assert {name: float(value) for name, value in values.items()} == expected
    assert set(observe.parts) == set(expected)


def test_alone_it_conditions_on_the_parameter(beam):
    model = cal.model(
        linear_forward(beam), parse_observation(beam, "parameter:mu"), cal.GaussianNoise(sd=1.0)
    )
    assert float(model.predict({"mu": 70.0, "lam": 60.0})[0]["parameter:mu"]) == 70.0
    with pytest.raises(InputError, match="MPa instead of kPa"):
        model.check_data(0.07)


def test_noise_of_what_has_no_place_or_no_default(ventricle, beam):
    observe = observations(cal.CavityVolume(ventricle))
    with pytest.raises(InputError, match="noise of volume: it correlates in space, but what is"):
        cal.model(linear_forward(ventricle), observe, CorrelatedNoise(9.0, 1.0, spatial_sd=1.0))
    run = Run("once_clamped_beam", observe="parameter:mu+length:3:14")
    parts = parse_observation(beam, run.observe)
    with pytest.raises(InputError, match="parameter:mu has no usual noise; give --noise parameter:mu=SD, in kPa"):  # fmt: skip
        run.named(parts)
    given = Run("once_clamped_beam", observe=run.observe, noise={"parameter:mu": 2.0})
    assert given.named(parts).noise == {"parameter:mu": 2.0, "length:3:14": 0.5}


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("length:3", "observe 'length:3': give length:FIRST:SECOND"),
        ("length:3:", "give length:FIRST:SECOND"),
        ("length:3:3", "both landmarks are at"),
        ("length:3:999", "node 999 is unknown"),
        ("length:3:tip", r"landmark 'tip' is neither a node, a node set \(apex_endocardium, "),
        ("length:3:0,0,500", "lies outside the body"),
        ("length:3:0,0,nan", "landmark '0,0,nan' is neither"),
        (
            "parameter:kappa",
            "parameter 'kappa' cannot be measured .*; it has a, b, a_f, b_f, press",
        ),
        ("parameter", "parameter '' cannot be measured"),
    ],
)
def test_words_that_ask_for_nothing(ventricle, word, message):
    with pytest.raises(InputError, match=message) as caught:
        parse_observation(ventricle, word)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("length:3:14\n-5\n", "length:3:14 is -5.0 mm; it must be above 0"),
        ("length:3:14\n0\n", "length:3:14 is 0.0 mm; it must be above 0"),
        ("parameter:a\n-1\n", "parameter 'a' is -1 kPa; it must be above 0"),
        ("parameter:pressure\n1\n2\n", "parameter:pressure has 2 values; give one, in kPa"),
        ("parameter:pressure\nNA\n", "every value of parameter:pressure is missing"),
    ],
)
def test_files_that_are_wrong(ventricle, tmp_path, text, message):
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_measurements(ventricle, tmp_path / "d.csv")
