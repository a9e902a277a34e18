"""What a posterior owes to its priors, against posteriors that are known in closed form."""

import numpy as np
import pytest

import calibrate as cal
from calibrate.posterior.reliance import LARGEST_MOVE, reliance_of, rests_on_prior
from certificate_support import linear_model


@pytest.fixture(scope="module")
def model(beam):
    """Of two moduli, with log-normal priors of 75 kPa and log sd 0.05, which fit into the box."""
    bare = linear_model(beam)
    prior = {"mu": cal.priors.log_normal(75.0, 0.05), "lam": cal.priors.log_normal(75.0, 0.05)}
    return cal.model(bare.full, bare.observe, cal.GaussianNoise(sd=0.1), prior)


def posterior_draws(shift, width, count=200_000):
    """Draws of the logarithm, whose likelihood is normal(``shift``, ``width``) in prior sds."""
    precision = 1.0 + width**-2
    mean, sd = shift * width**-2 / precision, precision**-0.5
    x = mean + sd * np.random.default_rng(0).normal(size=count)
    draw = 75.0 * np.exp(0.05 * x)
    return {"mu": draw, "lam": draw}


@pytest.mark.parametrize(("shift", "width"), [(2.0, 0.2), (1.0, 1.0), (3.0, 1.0), (0.0, 0.5)])
def test_the_move_is_that_of_a_prior_whose_sd_doubles(model, shift, width):
    """In closed form: the mean of a normal likelihood's posterior, under sd 1 + d in place of 1."""
    owed = reliance_of(model, posterior_draws(shift, width))["mu"]
    mean = lambda s: shift * width**-2 / (s**-2 + width**-2)
    sd = (1.0 + width**-2) ** -0.5
    slope = (mean(1.001) - mean(0.999)) / np.log(1.001 / 0.999)
    assert owed.move == pytest.approx(np.log(2.0) * slope / sd, abs=0.01)
    assert owed.of_prior == pytest.approx(sd, rel=0.01)


def test_only_a_mean_that_the_prior_decides_is_warned_of(model):
    draws = posterior_draws(3.0, 1.0) | {"lam": posterior_draws(0.5, 0.2)["lam"]}
    owed = reliance_of(model, draws)
    (sentence,) = rests_on_prior(owed)
    assert sentence.startswith("mu rests on its prior")
    assert owed["mu"].move > LARGEST_MOVE > abs(owed["lam"].move)


def test_a_range_is_no_prior_of_this_kind(beam):
    assert reliance_of(linear_model(beam), posterior_draws(0.0, 1.0)) == {}
