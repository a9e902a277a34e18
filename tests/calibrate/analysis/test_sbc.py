"""Simulation-based calibration passes what is right and fails what is wrong."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import numpyro.distributions as dist
import pytest

import calibrate as cal
from calibrate.analysis.sbc import (
    LOG_LIKELIHOOD,
    Calibration,
    Replicate,
    calibration_of,
    sbc,
)
from emulator.core.errors import InputError
from linear_support import closed_form, linear_forward

NODES = np.array([3, 11, 20])
MEAN, SD, NOISE = np.array([75.0, 75.0]), np.array([5.0, 8.0]), 0.1


@pytest.fixture(scope="module")
def forward(beam):
    return linear_forward(beam)


def make(beam, forward, sd=NOISE, prior_sd=SD):
    prior = {
        name: dist.Normal(m, s)
        for name, m, s in zip(beam.parameter_names, MEAN, prior_sd, strict=True)
    }
    observe = cal.nodal_displacements(beam, NODES)
    return cal.model(forward, observe, cal.GaussianNoise(sd=sd), prior, check_scale=False)


def exact(forward, sd=NOISE, prior_sd=SD):
    """Independent draws of the closed-form posterior."""

    def draw(data, seed):
        mean, covariance = closed_form(forward, NODES, data["displacement"], sd, MEAN, prior_sd)
        x = np.random.default_rng([seed, 7]).multivariate_normal(mean, covariance, 99)
        return {"mu": x[:, 0], "lam": x[:, 1]}

    return draw


@pytest.fixture(scope="module")
def truth(beam, forward):
    return make(beam, forward)


def run(model, truth, draw, replicates=200):
    return sbc(model, replicates, truth=truth, draw=draw, seed=1)


def test_a_right_posterior_passes_and_its_intervals_cover(truth, forward):
    found = run(truth, truth, exact(forward))
    assert set(found.ranks) == {"mu", "lam", LOG_LIKELIHOOD}
    assert found.replicates == 200
    assert found.passed
    for by_level in found.coverage().values():
        for level, (fraction, low, high) in by_level.items():
            assert low < level < high
            assert low < fraction < high


@pytest.mark.parametrize("wrong", ["noise", "wide noise", "prior", "biased map", "prior itself"])
def test_a_wrong_one_fails(beam, forward, truth, wrong):
    if wrong == "noise":
        model, draw = make(beam, forward, sd=0.5 * NOISE), exact(forward, sd=0.5 * NOISE)
    elif wrong == "wide noise":
        model, draw = make(beam, forward, sd=2.0 * NOISE), exact(forward, sd=2.0 * NOISE)
    elif wrong == "prior":
        sd = SD / 4.0
        model, draw = make(beam, forward, prior_sd=sd), exact(forward, prior_sd=sd)
    elif wrong == "biased map":
        biased = replace(forward, shift=forward.shift + NOISE)
        model, draw = make(beam, biased), exact(biased)
    else:  # draws that ignore the data: the parameters' ranks are uniform all the same
        model = truth

        def draw(data, seed):
            x = np.random.default_rng([seed, 7]).normal(MEAN, SD, (99, 2))
            return {"mu": x[:, 0], "lam": x[:, 1]}

    found = run(model, truth, draw)
    assert not found.passed
    if wrong == "prior itself":
        outside = found.outside()
        assert outside["mu"] == outside["lam"] == 0.0
        assert outside[LOG_LIKELIHOOD] > 0.1


@pytest.mark.parametrize("executor", ["processes:2", ThreadPoolExecutor(2)])
def test_ranks_are_the_same_by_every_engine(truth, forward, executor):
    here, there = (
        sbc(truth, 20, draw=exact(forward), seed=1, executor=where) for where in (None, executor)
    )
    for name, ranks in here.ranks.items():
        assert np.array_equal(ranks, there.ranks[name])


def test_false_alarms_are_as_rare_as_they_should_be():
    """Uniform ranks of three quantities: at 95 % together, some 10 of 200 checks fail."""
    rng = np.random.default_rng(0)
    checks = [Calibration({n: rng.random(100) for n in "abc"}).passed for _ in range(200)]
    assert 183 <= sum(checks) <= 199


def test_ranks_with_ties_are_uniform():
    """A quantity of few values: randomised ranks stay uniform."""
    rng = np.random.default_rng(3)
    each = (Replicate({"n": rng.integers(3)}, {"n": rng.integers(3, size=50)}) for _ in range(400))
    assert calibration_of(each).passed


def test_what_is_refused(truth, beam, forward):
    with pytest.raises(InputError, match="calibration: 3 replicates; give 20 or more"):
        run(truth, truth, exact(forward), replicates=3)
    other = cal.model(
        forward, cal.nodal_displacements(beam, [3]), cal.GaussianNoise(sd=0.1), truth.prior
    )
    with pytest.raises(InputError, match="has other unknowns or observations"):
        run(truth, other, exact(forward))
    broken = (Replicate({"n": 0.0}, {"n": np.array([np.nan, 1.0])}) for _ in range(20))
    with pytest.raises(InputError, match="a draw or truth of n is not finite"):
        calibration_of(broken)


@pytest.mark.slow
def test_nuts_is_calibrated(truth):
    options = cal.samplers.NUTSOptions(warmup=200, draws=300, chains=2, rounds=1)
    assert sbc(truth, 60, options=options, seed=3).passed
