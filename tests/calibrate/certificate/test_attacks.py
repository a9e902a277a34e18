"""Posteriors that are wrong by another route than the map's values: none of them is accepted.

Gradients that are not the map's, one observation of two, a noise level that one number has to tell.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
from certificate_support import exact_data, grid_of, linear_model, quadrature
from emulator.surrogates.protocol import Prediction
from linear_support import LinearForward, LinearSimulator, linear_forward

OPTIONS = cal.samplers.NUTSOptions(warmup=300, draws=500, rounds=1)
CLOSE_SD, CLOSE_SPREAD = 0.5, 0.25  # beyond either, no posterior may be accepted


@dataclass(frozen=True, eq=False)
class WrongGradients(LinearForward):
    """The right values; ``factor`` times the derivatives."""

    factor: float = 1.0

    def __call__(self, theta):
        exact = super().__call__
        wrong = self.factor * (exact(theta) - jax.lax.stop_gradient(exact(theta)))
        return jax.lax.stop_gradient(exact(theta)) + wrong

    def evaluate(self, theta):
        return Prediction(self(theta), jnp.all(theta < self.limit))


@pytest.fixture(scope="module")
def fem(beam):
    return linear_forward(beam, size=0.02)


def slowly(*values):
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


@pytest.mark.slow
@pytest.mark.parametrize("factor", [-1.0, *slowly(0.0, 0.2, 5.0)])
def test_gradients_that_are_not_the_map_s(beam, fem, factor):
    """Acceptance knows the values: draws are slow, or right, or the certificate sees it."""
    wrong = linear_forward(beam, size=0.02, of=WrongGradients, factor=factor)
    model = linear_model(beam, forward=wrong)
    data = exact_data(linear_model(beam, forward=fem))
    options = cal.samplers.NUTSOptions(
        warmup=100, draws=150, rounds=1
    )  # a wrong gradient makes long paths
    posterior = cal.sample(model, data, options=options, predictions=False)
    verdict = cal.certify(posterior, LinearSimulator(fem), draws=100).verdict
    points, weights = grid_of(), quadrature(fem, data)
    mean = weights @ points
    sd = np.sqrt(weights @ (points - mean) ** 2)
    draws = np.stack(list(posterior.draws().values()), axis=-1).reshape(-1, 2)
    shift = np.abs(draws.mean(axis=0) - mean) / sd
    spread = np.abs(draws.std(axis=0) / sd - 1.0)
    if (shift > CLOSE_SD).any() or (spread > CLOSE_SPREAD).any():
        assert verdict != "accepted"
    if factor in (-1.0, 5.0):  # trajectories are thrown off for good
        assert (shift > CLOSE_SD).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong_at", "good"), [((20,), False), *(pytest.param(*each, marks=pytest.mark.slow)
                                             for each in (((3, 11), False), ((), True)))]
)  # fmt: skip
def test_one_observation_of_two_is_wrong(beam, fem, wrong_at, good):
    """By five sd of its noise at every node it sees; the other one is exact. Neither is accepted."""
    shift = fem.shift.copy()
    shift[list(wrong_at)] += 0.5
    observe = {
        "first": cal.nodal_displacements(beam, [3, 11]),
        "second": cal.nodal_displacements(beam, [20]),
    }
    noise = dict.fromkeys(observe, cal.GaussianNoise(sd=0.1))
    u = np.asarray(fem(jnp.array([72.0, 68.0])))
    rng = np.random.default_rng(0)
    data = {
        name: u[part.nodes] + 0.1 * rng.normal(size=part.shape) for name, part in observe.items()
    }
    model = cal.model(replace(fem, shift=shift), observe, noise)
    posterior = cal.sample(model, data, options=OPTIONS, predictions=False)
    verdict = cal.certify(posterior, LinearSimulator(fem), draws=100).verdict
    assert (verdict == "accepted") is good


@pytest.mark.slow
def test_a_noise_level_from_one_number(beam, fem):
    """Its posterior narrows to a needle at sd 0. NUTS says that it does not follow it; importance
    sampling does, and FEM agrees with it where the map is right.
    """
    observe = cal.length_between(beam, "left", "right")
    noise = cal.GaussianNoise(sd_scale=0.2)
    model = cal.model(fem, observe, noise, bounded=("mu", "lam"))  # one number leaves both open
    theta = jnp.array([72.0, 68.0])
    data = float(observe(fem(theta)[observe.nodes], theta)) + 0.1
    posterior = cal.sample(model, data)
    sd = posterior.draws()["noise_sd"]
    # By quadrature over the unit box, on which the prior of theta is uniform.
    unit = (np.arange(200) + 0.5) / 200
    thetas = np.stack(np.meshgrid(50.0 * 2.0**unit, 50.0 * 2.0**unit), axis=-1).reshape(-1, 2)
    lengths = jax.vmap(lambda t: observe(fem(t)[observe.nodes], t))(jnp.asarray(thetas))
    grid = np.linspace(0.0, 1.2, 2401)[1:, None]
    density = np.exp(-0.5 * ((data - np.asarray(lengths)) / grid) ** 2).mean(axis=1) / grid[:, 0]
    weights = density * np.exp(-0.5 * (grid[:, 0] / 0.2) ** 2)
    weights /= weights.sum()
    mean = weights @ grid[:, 0]
    spread = np.sqrt(weights @ (grid[:, 0] - mean) ** 2)
    assert abs(sd.mean() - mean) < 4.0 * spread / np.sqrt(len(sd))
    assert sd.std() == pytest.approx(spread, rel=0.05)
    assert cal.certify(posterior, LinearSimulator(fem)).verdict == "accepted"
    by_nuts = cal.sample(model, data, sampler="nuts")
    certificate = cal.certify(by_nuts, LinearSimulator(fem), draws=100)
    assert certificate.verdict != "accepted"
    assert "transitions diverged" in " ".join(certificate.findings)
    wrong = replace(fem, matrix=1.5 * fem.matrix)
    posterior = cal.sample(replace(model, forward=wrong.at(observe.nodes)), data)
    certificate = cal.certify(posterior, LinearSimulator(fem), draws=100)
    assert certificate.verdict != "accepted"
    assert "mean of noise_sd moves" in " ".join(certificate.findings)
