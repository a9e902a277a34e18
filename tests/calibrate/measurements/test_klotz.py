"""The end-diastolic pressure-volume relation of Klotz et al., alone and as an observation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import calibrate as cal
from calibrate.measurements import observations, observations_from_json, parse_observation
from calibrate.measurements.data import read_measurements, write_data
from calibrate.project import Run
from calibrate.samplers.laplace import LaplaceOptions
from emulator.core.errors import InputError
from emulator.scenes.loads import KPA_PER_MMHG
from klotz_support import PRIOR, lengthening, model_of
from linear_support import linear_forward

A, B = 27.78, 2.76  # mmHg, 1


def published(volume, mmhg):
    """V_0 and V_30 in mL, from mmHg as printed."""
    rest = volume * (0.6 - 0.006 * mmhg)
    return rest, rest + (volume - rest) / (mmhg / A) ** (1.0 / B)


@pytest.mark.parametrize("mmhg", [2.0, 10.0, 22.0, 22.5, 27.78, 35.0])
def test_the_curves_are_the_published_ones(mmhg):
    volume, pressure = 120.0, mmhg * KPA_PER_MMHG
    klotz = cal.Klotz(volume, pressure)
    rest, at_30 = published(volume, mmhg)
    assert klotz.unloaded == pytest.approx(rest, rel=1e-12)
    # The normalised curve, with the A_n that cancels in ours.
    volumes = rest + (at_30 - rest) * np.linspace(0.05, 1.1, 9)
    expected = A * ((volumes - rest) / (at_30 - rest)) ** B * KPA_PER_MMHG
    np.testing.assert_allclose(klotz.pressure(volumes), expected, rtol=1e-10)
    np.testing.assert_allclose(klotz.volume(expected), volumes, rtol=1e-10)
    assert float(klotz.volume(pressure)) == volume
    assert float(klotz.pressure(volume)) == pressure
    assert float(klotz.volume(0.0)) == float(klotz.volume(-1.0)) == klotz.unloaded
    assert float(klotz.pressure(0.9 * rest)) == 0.0


def test_slopes_are_those_of_differences():
    def numbers(point):
        klotz = cal.Klotz(point[0], point[1])
        return jnp.stack([klotz.volume(0.7), klotz.pressure(105.0)])

    point = jnp.array([120.0, 1.3])
    found = jax.jit(jax.jacrev(numbers))(point)
    for k, step in enumerate((1e-3, 1e-5)):
        move = step * jnp.eye(2)[k]
        difference = (numbers(point + move) - numbers(point - move)) / (2.0 * step)
        np.testing.assert_allclose(found[:, k], difference, rtol=1e-7)
    at_rest = jax.grad(lambda p: cal.Klotz(120.0, 1.3).volume(p))
    assert float(at_rest(0.0)) == 0.0
    assert float(jax.grad(cal.Klotz(120.0, 1.3).pressure)(50.0)) == 0.0


def test_an_observation_is_the_point_whose_curve_passes_through_the_body(ventricle):
    forward, pressure = linear_forward(ventricle, size=0.3), 1.3
    observe = cal.KlotzVolume(ventricle, pressure)
    theta = ventricle.theta(a=0.3, b=2.0, a_f=5.0, b_f=1.7, pressure=0.7)
    u = forward(theta)[observe.nodes]
    volume = float(cal.CavityVolume(ventricle)(u, theta))
    found = float(observe(u, theta))
    through = brentq(lambda v: float(cal.Klotz(v, pressure).volume(0.7)) - volume, 50.0, 500.0)
    assert found == pytest.approx(through, rel=1e-10)
    at_it = theta.at[-1].set(pressure)
    assert float(observe(u, at_it)) == pytest.approx(volume, rel=1e-12)
    # Its sd: pressures that scatter move it as the slope of the curve through the point says.
    moved = [float(observe(u, theta.at[-1].set(0.7 + h))) for h in (-1e-5, 1e-5)]
    klotz = cal.Klotz(found, pressure)
    assert float(klotz.sd(0.7, 1e-5)) == pytest.approx((moved[0] - moved[1]) / 2.0, rel=1e-6)


@pytest.mark.parametrize("suffix", [".csv", ".nc"])
def test_a_pressure_is_written_as_it_was_given(ventricle, tmp_path, suffix):
    observe = observations(parse_observation(ventricle, "volume@ED+klotz:1.30@low"))
    data = {"volume@ED": 130.0, "klotz:1.30@low": 131.0}
    write_data(tmp_path / f"d{suffix}", observe, data)
    back, values = read_measurements(ventricle, tmp_path / f"d{suffix}")[:2]
    assert {name: float(value) for name, value in values.items()} == data
    assert back.parts["klotz:1.30@low"].measured_pressure == 1.3
    renamed = {"klotz:1.4@low": observe.parts["klotz:1.30@low"]}
    with pytest.raises(InputError, match=r"'klotz:1.4@low' does not fit .* called klotz:1.3"):
        write_data(tmp_path / "e.csv", observations(renamed), {"klotz:1.4@low": 1.0})


def test_one_measured_volume_in_two_more_states(ventricle, tmp_path):
    """By densities: data at one pressure and the relation, from a file as people write it."""
    (tmp_path / "d.csv").write_text(
        "state,volume,klotz:1.3\nED,130,\nlow,,130\nmiddle,,130\n", encoding="utf-8"
    )
    observe, data = read_measurements(ventricle, tmp_path / "d.csv")[:2]
    names = ["volume@ED", "klotz:1.3@low", "klotz:1.3@middle"]
    assert sorted(observe.parts) == sorted(names)
    again = observations_from_json(ventricle, observe.to_json())
    assert again.parts["klotz:1.3@low"].measured_pressure == 1.3
    known = {"pressure@ED": 1.3, "pressure@low": 0.6}
    noise = {"volume": cal.GaussianNoise(sd=2.0), "klotz:1.3": cal.GaussianNoise(sd=5.0)}
    forward = linear_forward(ventricle, size=0.3)
    model = cal.model(forward, observe, noise, known=known, check_scale=False)
    assert model.states.unknowns == ("a", "b", "a_f", "b_f", "pressure@middle")
    draw = {"a": 0.3, "b": 2.0, "a_f": 5.0, "b_f": 1.7, "pressure@middle": 0.9}
    means, _ = model.predict(draw)
    checked = model.check_data(data)
    density = float(model.log_density({}, means, checked))
    thetas = dict(zip(model.states.states, model.states.thetas(draw), strict=True))
    expected = 0.0
    for name, sd in zip(names, (2.0, 5.0, 5.0), strict=True):
        theta = thetas[name.split("@")[1]]
        part = cal.CavityVolume(ventricle)
        volume = float(part(forward(theta)[part.nodes], theta))
        # The relation as printed: V = V_m (rest + (1 - rest) (P / P_m)^(1 / B)).
        rest = 0.6 - 0.006 * 1.3 / KPA_PER_MMHG
        k = rest + (1.0 - rest) * (float(theta[-1]) / 1.3) ** (1.0 / B)
        expected += -0.5 * ((130.0 - volume / k) / sd) ** 2 - np.log(sd * np.sqrt(2.0 * np.pi))
    assert density == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda s: cal.Klotz(0.0, 1.3), "the measured volume is 0.0 mL; it must be above 0"),
        (lambda s: cal.Klotz(120.0, 10.0), r"is 10.0 kPa; it must .* 5.33 kPa \(40 mmHg; 1 mmHg"),
        (lambda s: cal.Klotz(120.0, float("nan")), "the measured pressure is nan kPa"),
        (
            lambda s: parse_observation(s, "klotz"),
            "observe 'klotz': give klotz:MEASUREDPRESSURE in kPa",
        ),
        (lambda s: parse_observation(s, "klotz:high"), "such as klotz:1.3"),
        (lambda s: parse_observation(s, "klotz:-1"), "klotz:-1.0: the measured pressure is -1.0"),
        (
            lambda s: Run("x", observe="klotz:1.3").named(parse_observation(s, "klotz:1.3")),
            "klotz:1.3 has no usual noise; give --noise klotz:1.3=SD, in mL",
        ),
    ],
)
def test_what_is_refused(ventricle, make, message):
    with pytest.raises(InputError, match=message) as caught:
        make(ventricle)
    assert "\n" not in str(caught.value)


def test_a_body_without_a_cavity(beam):
    with pytest.raises(InputError, match="klotz:1.3: scene .* has no cavity whose pressure is a"):
        parse_observation(beam, "klotz:1.3")


@pytest.mark.slow  # compiles a sampler
def test_the_relation_tells_the_shape_of_the_curve(ventricle):
    """One volume tells one of two unknowns; with the relation the posterior is the linear one."""
    forward = lengthening(ventricle)
    sds = {"volume@ED": 1.0, "klotz:1.3@low": 2.0, "klotz:1.3@middle": 2.0}
    at = {"pressure@ED": 1.3, "pressure@low": 0.6, "pressure@middle": 0.9}
    model = model_of(forward, PRIOR, sds, **at)
    posterior = cal.sample(
        model, dict.fromkeys(sds, 130.0), sampler="laplace", options=LaplaceOptions(400, 2, 4)
    )
    draws = np.stack([np.ravel(posterior.tree["posterior"][n]) for n in ("a", "b")], axis=1)
    # 130 mL at 1.3 kPa on Klotz's curve: a = 10 and b = 1, with the spread of the linear model.
    x, weights = jnp.array([10.0, 1.0]), 1.0 / np.array(list(sds.values()))

    def numbers(x):
        means, _ = model.predict({"a": x[0], "b": x[1]})
        return jnp.stack([means[name] for name in sds])

    np.testing.assert_allclose(numbers(x), 130.0, rtol=1e-9)
    slopes = weights[:, None] * np.asarray(jax.jacfwd(numbers)(x))
    covariance = np.linalg.inv(slopes.T @ slopes)
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((draws.mean(axis=0) - x) / sd, 0.0, atol=0.3)
    np.testing.assert_allclose(draws.std(axis=0), sd, rtol=0.15)
