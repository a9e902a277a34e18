"""Inferred noise that has taken up the misfit of a law, told from scatter."""

import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.posterior.taken_up import sentences, taken_up
from emulator.scenes import Parameter
from emulator.specimens.specimen import specimen

STRETCH = np.linspace(1.0, 1.3, 40)


def model_of(noise):
    strip = specimen(
        {"stretch_x": STRETCH},
        law=em.find_law("neo_hookean"),
        parameters=(Parameter("mu", "kPa", 1.0, 50.0),),
        constants={"lam": 10.0},
    )
    forward = em.homogeneous(strip)
    return cal.model(forward, cal.stresses(strip, "stress_x"), noise, check_scale=False)


@pytest.mark.parametrize(
    ("noise", "sds"),
    [
        (cal.GaussianNoise(sd_scale=0.5), {"noise_sd": 1.4}),
        (
            cal.CorrelatedNoise(length=0.1, sd_scale=0.5, spatial_sd_scale=0.5),
            {"noise_sd": 0.1, "spatial_sd": 1.4},
        ),
    ],
)
def test_a_law_that_bends_the_other_way_is_told_from_scatter(noise, sds):
    """An exponential tissue, a neo-Hookean law; then a law that fits, with as much scatter."""
    model, rng = model_of(noise), np.random.default_rng(0)
    draws = {"mu": np.full(8, 10.0)} | {name: np.full(8, sd) for name, sd in sds.items()}
    means = np.asarray(model.predict({"mu": jnp.asarray(10.0)})[0]["stress"])
    bend = 2.0 * np.sin(3.0 * np.pi * (STRETCH - 1.0) / 0.3)[:, None]
    (missed,) = taken_up(model, model.check_data(means + bend + 0.1 * rng.normal(size=bend.shape)),
                         draws)  # fmt: skip
    assert missed.is_misfit
    assert missed.sd > 1.3
    assert 0.05 < missed.scatter < 0.5
    (line,) = sentences([missed])
    assert "% of the largest" in line
    assert "try another law" in line
    scattered = model.check_data(means + 1.4 * rng.normal(size=bend.shape))
    (noisy,) = taken_up(model, scattered, draws)
    assert noisy.scatter == pytest.approx(1.4, rel=0.25)
    assert sentences([noisy]) == []


def test_data_without_noise_are_said_to_have_none():
    model = model_of(cal.GaussianNoise(sd_scale=0.5))
    draws = {"mu": np.full(8, 10.0), "noise_sd": np.full(8, 1e-7)}
    exact = model.predict({"mu": jnp.asarray(10.0)})[0]["stress"]
    (line,) = sentences(taken_up(model, {"stress": exact}, draws))
    assert line.endswith(
        "no measurement is that exact, and no forward map; give the noise of the test that the "
        "data stand for (--noise stress=SD)"
    )


def test_known_noise_takes_up_nothing():
    model = model_of(cal.GaussianNoise(sd=0.5))
    data = model.check_data(np.zeros((40, 1)))
    assert list(taken_up(model, data, {"mu": np.full(8, 10.0)})) == []
