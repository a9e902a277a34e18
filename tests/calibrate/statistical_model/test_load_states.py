"""Several load states of one body, against densities and files written by hand."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.infer.util import log_density

import calibrate as cal
from calibrate.measurements import observations, parse_observation, spread_landmarks
from calibrate.measurements.data import read_measurements, write_data
from calibrate.project import Run
from calibrate.statistical_model.load_states import known_thetas, load_states
from data_support import make_data
from emulator.core.errors import InputError
from linear_support import LinearForward, linear_forward

MATERIAL = {"a": 0.3, "b": 2.0, "a_f": 5.0, "b_f": 1.7}


def test_loads_belong_to_a_state_and_the_material_does_not(ventricle):
    states, prior = load_states(ventricle, ("low", "high"), known={"pressure@low": 0.6})
    assert states.unknowns == (*MATERIAL, "pressure@high")
    assert set(prior) == set(states.unknowns)
    thetas = states.thetas({**MATERIAL, "pressure@high": jnp.array([1.1, 1.2, 1.3])})
    assert thetas.shape == (3, 2, 5)
    np.testing.assert_allclose(thetas[:, 0], [[*MATERIAL.values(), 0.6]] * 3)
    np.testing.assert_allclose(thetas[:, 1, 4], [1.1, 1.2, 1.3])
    np.testing.assert_array_equal(states.values(thetas[1]), [*MATERIAL.values(), 1.2])
    # In one state without a name a parameter keeps its own name.
    assert load_states(ventricle, ("",))[0].unknowns == ventricle.parameter_names
    # A prior under the bare name is each state's.
    given = {**cal.priors.box_prior(ventricle), "pressure": dist.Uniform(0.5, 1.0)}
    states, prior = load_states(ventricle, ("low", "high"), given)
    assert states.unknowns[-2:] == ("pressure@low", "pressure@high")
    assert prior["pressure@low"] is prior["pressure@high"] is given["pressure"]


def test_what_a_prior_does_not_name_has_the_box_and_a_state_goes_before_all(ventricle):
    given = {"a": dist.Uniform(0.25, 0.5), "pressure": dist.Uniform(0.6, 1.0)}
    states, prior = load_states(ventricle, ("low", "mid"), given, {"pressure@mid": 0.9})
    assert states.unknowns == (*MATERIAL, "pressure@low")
    assert prior["a"] is given["a"]
    assert prior["pressure@low"] is given["pressure"]
    box = cal.priors.box_prior(ventricle)["b"]
    assert float(prior["b"].icdf(0.3)) == float(box.icdf(0.3))
    # And a prior of one state before a value known in every other.
    given = {"pressure@low": dist.Uniform(0.6, 1.0)}
    states, _ = load_states(ventricle, ("low", "mid"), given, {"pressure": 0.9})
    assert states.unknowns == (*MATERIAL, "pressure@low")


@pytest.mark.parametrize(
    ("prior", "known", "message"),
    [
        (None, {"pressure@top": 1.0}, "load state 'top' is unknown; known: low, high"),
        (None, {"a": float("nan")}, "known: 'a' is nan; give a finite number"),
        (None, {"presure": 1.0}, "has no parameter 'presure'; it has a, b, a_f, b_f, pressure"),
        ({"a": dist.Uniform(0.1, 0.5)}, {"a": 0.3}, "'a' is known and has a prior"),
        (None, {**MATERIAL, "pressure": 1.0}, "every parameter is known; leave one"),
    ],
)
def test_names_that_do_not_fit(ventricle, prior, known, message):
    with pytest.raises(InputError, match=message):
        load_states(ventricle, ("low", "high"), prior, known)


def test_thetas_of_synthetic_data(ventricle):
    values = {**MATERIAL, "pressure@low": 0.6, "pressure@high": 1.1}
    thetas = known_thetas(ventricle, ("low", "high"), values)
    np.testing.assert_allclose(thetas, [[*MATERIAL.values(), p] for p in (0.6, 1.1)])
    with pytest.raises(InputError, match="no value for parameter 'pressure@high'"):
        known_thetas(ventricle, ("low", "high"), {**MATERIAL, "pressure@low": 0.6})
    with pytest.raises(InputError, match="pressure.* is 50 kPa"):
        known_thetas(ventricle, ("low", "high"), {**values, "pressure@high": 50.0})


@pytest.fixture(scope="module")
def curve(ventricle):
    """A volume in two states, landmarks in one; the map is linear in theta."""
    points = spread_landmarks(ventricle, 4, seed=1)
    volume = cal.CavityVolume(ventricle)
    observe = observations(
        {
            "volume@low": volume,
            "volume@high": volume,
            "displacement@high": cal.landmarks(ventricle, points),
        }
    )
    return linear_forward(ventricle, size=1.0), observe


def test_the_density_is_the_product_over_states(ventricle, curve):
    """Against two models of one state each, at the same theta."""
    forward, observe = curve
    noise = {"volume": cal.GaussianNoise(sd_scale=2.0), "displacement": cal.GaussianNoise(sd=0.5)}
    known = {"pressure@low": 0.6}
    model = cal.model(forward, observe, noise, known=known)
    assert model.names == (*MATERIAL, "pressure@high", "noise_sd_volume")
    draw = {**MATERIAL, "pressure@high": 1.1, "noise_sd_volume": 1.5}
    draw = {name: jnp.asarray(value) for name, value in draw.items()}
    exact, valid = model.predict(draw)
    assert bool(valid)
    rng = np.random.default_rng(0)
    data = {k: np.asarray(v) + 0.3 * rng.normal(size=v.shape) for k, v in exact.items()}
    found, _ = log_density(model, (model.check_data(data),), {}, draw)

    low = cal.model(
        forward, {"volume": observe.parts["volume@low"]}, cal.GaussianNoise(sd=1.5),
        known={"pressure": 0.6},
    )  # fmt: skip
    high = cal.model(
        forward,
        {
            "volume": observe.parts["volume@high"],
            "displacement": observe.parts["displacement@high"],
        },
        {"volume": cal.GaussianNoise(sd=1.5), "displacement": cal.GaussianNoise(sd=0.5)},
    )
    one, _ = log_density(low, ({"volume": data["volume@low"]},), {}, draw)
    at_high = {"volume": data["volume@high"], "displacement": data["displacement@high"]}
    two, _ = log_density(high, (at_high,), {}, {**draw, "pressure": jnp.asarray(1.1)})
    prior = sum(model.prior[name].log_prob(draw[name]) for name in MATERIAL)
    half_normal = dist.HalfNormal(2.0).log_prob(1.5)
    # The material's prior is in both, and the shared noise's in neither.
    assert float(found) == pytest.approx(float(one + two - prior + half_normal), rel=1e-10)


def test_noise_may_differ_between_states(curve):
    forward, observe = curve
    own = {
        "volume@low": cal.GaussianNoise(sd_scale=2.0),
        "volume@high": cal.GaussianNoise(sd_scale=3.0),
        "displacement": cal.GaussianNoise(sd=0.5),
    }
    model = cal.model(forward, observe, own)
    assert model.names[-2:] == ("noise_sd_volume@low", "noise_sd_volume@high")
    with pytest.raises(InputError, match="noise: 'volume@mid' is not observed; observed: volume@"):
        cal.model(forward, observe, {**own, "volume@mid": own["volume@low"]})


def test_one_call_of_the_forward_map_serves_all_states(ventricle, curve):
    calls = []

    class Counted(LinearForward):
        def __call__(self, theta):
            calls.append(theta.shape)
            return super().__call__(theta)

    _, observe = curve
    noise = dict.fromkeys(("volume", "displacement"), cal.GaussianNoise(sd=1.0))
    model = cal.model(linear_forward(ventricle, size=1.0, of=Counted), observe, noise)
    calls.clear()
    thetas = jnp.stack([ventricle.centre, ventricle.centre])
    assert model.evaluate(thetas).displacement.shape == (2, len(observe.nodes), 3)
    assert calls == [(5,)]  # traced once, batched


def test_known_values_outside_the_range_of_the_map_are_refused(ventricle, curve):
    forward, observe = curve
    limited = replace(forward, limit=60.0)
    noise = dict.fromkeys(("volume", "displacement"), cal.GaussianNoise(sd=1.0))
    with pytest.raises(InputError, match=r"'pressure' is known to be 90 kPa; forward map 'linear'"):
        cal.model(limited, observe, noise, known={"pressure@low": 90.0})
    with pytest.raises(InputError, match="noise: give one for each of volume, displacement, by"):
        cal.model(forward, observe, cal.GaussianNoise(sd=1.0))
    volumes = {name: part for name, part in observe.parts.items() if "volume" in name}
    assert len(cal.model(forward, volumes, cal.GaussianNoise(sd_scale=1.0)).names) == 7


@pytest.mark.parametrize("file", ["d.csv", "d.nc"])
def test_files_keep_states(ventricle, curve, tmp_path, file):
    _, observe = curve
    rng = np.random.default_rng(0)
    data = {n: np.abs(rng.normal(size=shape)) for n, shape in observe.shapes.items()}
    write_data(tmp_path / file, observe, data)
    back, values = read_measurements(ventricle, tmp_path / file)[:2]
    assert back.states == ("low", "high")
    assert set(back.parts) == set(observe.parts)
    for name in data:
        np.testing.assert_array_equal(values[name], data[name])
    np.testing.assert_array_equal(
        back.parts["displacement@high"].points, observe.parts["displacement@high"].points
    )


def test_a_pressure_volume_curve_as_people_write_it(ventricle, tmp_path):
    path = tmp_path / "curve.csv"
    path.write_text("state;volume\nED;120,5\nES;60\n")
    observe, data = read_measurements(ventricle, path)[:2]
    assert {k: float(v) for k, v in data.items()} == {"volume@ED": 120.5, "volume@ES": 60.0}
    assert observe.states == ("ED", "ES")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("state,volume\nED,120\n,60\n", "row 2, column 'state' is ''; give every row"),
        ("state,volume\nE@D,120\n", "row 1, column 'state' is 'E@D'; give every row"),
        ("state,volume\nED,120\nED,130\n", "state 'ED': volume has 2 values; give one"),
        (
            "state,volume\nED,120\nES,-1\n",
            "state 'ES': data: volume@ES is -1.0 mL; it must be above",
        ),
    ],
)
def test_files_with_states_that_are_wrong(ventricle, tmp_path, text, message):
    path = tmp_path / "d.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_measurements(ventricle, path)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["volume", "volume@low"], "'volume' names no load state, others do: low"),
        (["volume@"], "'volume@': write name@state"),
        (["volume@a@b"], "write name@state"),
    ],
)
def test_names_with_and_without_a_state_do_not_mix(ventricle, names, message):
    with pytest.raises(InputError, match=message):
        observations(dict.fromkeys(names, cal.CavityVolume(ventricle)))


def test_observations_of_a_run_are_made_in_every_state(ventricle, monkeypatch):
    spread = parse_observation(ventricle, "volume+nodes:3@low", 0, ("low", "high"))
    assert list(spread.parts) == ["volume@low", "volume@high", "displacement@low"]
    forward = linear_forward(ventricle, size=1.0)
    monkeypatch.setattr("calibrate.project.problem.simulator_of", lambda *_: forward)
    run = Run(
        "left_ventricle",
        truth={**MATERIAL, "pressure@high": 1.1},
        known={"pressure@low": 0.6},
        observe="volume+nodes:3@low",
        noise={"volume": 0.5},
    )
    observe, data = make_data(run, ventricle)
    assert list(data) == ["volume@low", "volume@high", "displacement@low"]
    assert run.named(observe).noise == {"volume": 0.5, "displacement": 0.2}
    assert set(run.noises(observe)) == {"volume", "displacement"}
    bare = Run("left_ventricle", noise=0.1).named(observe)
    assert bare.noise == {"displacement": 0.1, "volume": 1.0}
