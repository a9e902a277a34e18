"""Forces of supports as data: of plates that are moved by a known amount in each load state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.measurements import Reaction, observations_from_json, parse_observation
from calibrate.measurements.data import read_measurements, write_data
from calibrate.measurements.observation import check_values
from calibrate.measurements.usual_noise import usual_noise
from emulator.core.errors import InputError
from emulator.surrogates.taylor import expand
from scene_support import between_plates

WORDS = "reaction:top:x@a+reaction:top:x@b+reaction:top:0,0,-1@b"
KNOWN = {"shear@a": 0.1, "shear@b": 0.3, "stretch": 0.0}


@pytest.fixture(scope="module")
def simulator():
    return em.Simulator(between_plates())


@pytest.fixture(scope="module")
def forward(simulator):
    return em.Emulator(simulator.scene, taylor=expand(simulator, order=3)).cache()


def test_it_is_the_simulators_resultant_in_newtons(simulator):
    theta = simulator.scene.theta(mu=4.0, shear=0.3, stretch=0.1)
    u = simulator(theta)
    total = np.asarray(simulator.reaction("top", u, theta))
    for direction, expected in (
        ("x", total[0]),
        ("z", total[2]),
        ("0,3,-4", total @ [0, 0.6, -0.8]),
    ):
        seen = Reaction(simulator.scene, "top", direction)
        assert seen(u[seen.nodes], theta) == pytest.approx(1e-3 * expected, rel=1e-10, abs=1e-12)


def test_a_batch_is_one_by_one(simulator, forward):
    thetas = jnp.array([[2.0, 0.1, 0.0], [5.0, -0.2, 0.1]])
    seen = Reaction(simulator.scene, "bottom", "x")
    near = forward.at(seen.nodes)
    force = jax.jit(lambda theta: seen(near(theta), theta))
    np.testing.assert_allclose(force(thetas), [force(t) for t in thetas], rtol=1e-12)


def test_its_derivative_is_a_central_difference(simulator):
    seen = Reaction(simulator.scene, "top", "x")
    theta = simulator.scene.theta(mu=4.0, shear=0.2, stretch=0.05)

    resultant = jax.jit(seen)

    def force(theta):
        return resultant(simulator(theta)[seen.nodes], theta)

    found = jax.grad(force)(theta)
    for k, h in enumerate((1e-3, 1e-5, 1e-5)):
        step = h * np.eye(3)[k]
        by_differences = (force(theta + step) - force(theta - step)) / (2.0 * h)
        assert found[k] == pytest.approx(float(by_differences), rel=1e-5)


def test_forces_in_load_states_tell_the_modulus(simulator, forward):
    observe = parse_observation(simulator.scene, WORDS)
    noise = {
        "reaction:top:x": cal.GaussianNoise(sd=1e-4),
        "reaction:top:0,0,-1": cal.GaussianNoise(sd=1e-3),
    }
    model = cal.model(forward, observe, noise, known=KNOWN)
    assert model.states.unknowns == ("mu",)
    exact, valid = jax.jit(model.predict)({"mu": jnp.asarray(3.0)})
    assert bool(valid)
    likelihood = jax.jit(lambda mu: model.map_log_likelihood({"mu": mu}, exact))
    at = [float(likelihood(mu)) for mu in (2.9, 3.0, 3.1)]
    assert at[1] > max(at[0], at[2])
    # Force is proportional to mu where lam is small beside it; here it is not, so only ordered.
    assert 0.0 < exact["reaction:top:x@a"] < exact["reaction:top:x@b"]


def test_from_words_to_files_and_back(simulator, tmp_path):
    observe = parse_observation(simulator.scene, WORDS)
    data = dict(zip(observe.parts, map(np.asarray, (0.01, 0.03, -0.002)), strict=True))
    for file in ("d.csv", "d.nc"):
        write_data(tmp_path / file, observe, data)
        back, values = read_measurements(simulator.scene, tmp_path / file)[:2]
        assert {k: float(v) for k, v in values.items()} == {k: float(v) for k, v in data.items()}
        assert list(back.parts) == list(observe.parts)
    again = observations_from_json(simulator.scene, observe.to_json())
    np.testing.assert_array_equal(again.nodes, observe.nodes)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("reaction:top", "give reaction:SUPPORT:DIRECTION, such as reaction:top:x"),
        ("reaction:side:x", "no support on 'side'; it has bottom, top"),
        ("reaction:top:up", "direction 'up' of a reaction; give x, y, z or three numbers"),
        ("reaction:top:0,0,0", "give 3 numbers, not all 0"),
    ],
)
def test_forces_of_what_is_no_support(simulator, word, said):
    with pytest.raises(InputError, match=said):
        parse_observation(simulator.scene, word)


def test_a_force_has_no_usual_noise(simulator):
    seen = Reaction(simulator.scene, "top", "x")
    with pytest.raises(InputError, match="give --noise reaction:top:x=SD, in N"):
        usual_noise(seen)
    with pytest.raises(InputError, match="must be finite"):
        check_values(seen, "reaction:top:x", np.asarray(np.inf))
    check_values(seen, "reaction:top:x", np.asarray(-0.3))
