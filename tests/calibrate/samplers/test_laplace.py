"""The Laplace approximation: exact for a Gaussian posterior, and honest about others.

Modes that draws have missed are reported; funnels, ridges and light modes are not.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.distributions import Normal

import calibrate as cal
from calibrate.posterior.diagnosis import diagnose
from calibrate.samplers import Density, LaplaceOptions
from calibrate.samplers.density import prior_draws
from calibrate.samplers.laplace import (
    MISSED_AT,
    MISSED_BY,
    Modes,
    draws_beside,
    find_modes,
    missed_mode,
)
from emulator.core.errors import SolverError
from linear_support import LinearForward, linear_forward, linear_problem


@dataclass(frozen=True, eq=False)
class Bent(LinearForward):
    """Only a curved combination of the two parameters is seen."""

    def __call__(self, theta):
        x, y = (theta[0] - 75.0) / 5.0, (theta[1] - 75.0) / 5.0
        return jnp.ones((len(self.nodes), 3)) * (y - x**2)


def bent(beam):
    forward = linear_forward(beam, of=Bent)
    prior = {name: dist.Normal(75.0, 10.0) for name in beam.parameter_names}
    observe = cal.nodal_displacements(beam, [3])
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.05), prior, check_scale=False)
    return model, np.zeros((1, 3))


def test_of_a_gaussian_posterior_it_is_exact(beam):
    model, data = linear_problem(beam)
    posterior = cal.sample(model, data, sampler="laplace", options=LaplaceOptions(draws=500))
    ratios = posterior.tree["sample_stats"]["log_ratio"].values
    assert np.ptp(ratios) < 1e-5
    assert posterior.tree.attrs["pareto_k"] == 0.0
    assert posterior.tree.attrs["approximation"] == "gaussian"
    assert posterior.warnings() == []


@pytest.mark.slow
def test_the_ratio_of_a_gaussian_is_its_evidence(beam):
    """log p(z, y) - log q(z) is log p(y) where q is the posterior: SMC's estimate of it."""
    model, data = linear_problem(beam)
    laplace = cal.sample(model, data, sampler="laplace", options=LaplaceOptions(draws=50))
    smc = cal.sample(model, data, sampler="smc", seed=3)
    error = smc.tree.attrs["log_evidence_error"]
    found = float(laplace.tree["sample_stats"]["log_ratio"].mean())
    assert found == pytest.approx(smc.tree.attrs["log_evidence"], abs=5.8 * error)


def test_of_a_bent_posterior_it_says_that_it_is_wrong(beam):
    model, data = bent(beam)
    posterior = cal.sample(model, data, sampler="laplace", options=LaplaceOptions(draws=500))
    # Too wide where the posterior bends away: no heavy tail, but hardly a draw that counts.
    assert posterior.tree.attrs["importance_efficiency"] < 0.2
    assert any("the Gaussian approximation is poor" in line for line in posterior.warnings())


def test_a_mode_between_walls_is_refused(beam):
    """A likelihood that grows to where the map ends has no mode before it."""
    from dataclasses import replace

    forward = replace(linear_forward(beam), limit=75.0)
    prior = {name: dist.Uniform(60.0, 80.0) for name in beam.parameter_names}
    observe = cal.nodal_displacements(beam, [3])
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.001), prior, check_scale=False)
    truth = np.asarray(replace(forward, limit=np.inf).at(observe.nodes)(jnp.array([79.0, 79.0])))
    # Round-off decides where the optimiser stops at the wall, and so which of the two is said.
    said = "the optimiser stopped .* sd from a mode|no curvature at its mode"
    with pytest.raises(SolverError, match=said):
        cal.sample(model, truth, sampler="laplace")


@dataclass(frozen=True, eq=False)
class Even(LinearForward):
    """Only the square of mu's distance from 75 kPa is seen, ``slope`` sd higher on one side."""

    slope: float = 0.0

    def __call__(self, theta):
        x = (theta[0] - 75.0) / 5.0
        y = (theta[1] - 75.0) / 5.0
        return jnp.ones((len(self.nodes), 3)) * jnp.array([x**2 - 1.0, self.slope * x, y])


@pytest.mark.parametrize(("slope", "told"), [(0.0, True), (0.02, True), (0.5, False)])
def test_a_second_mode_nearly_as_high_is_told(beam, slope, told):
    """At x = -1 the log density is (2 slope / 0.1)^2 / 2 below that at x = 1: 0.08 and 50 nats."""
    forward = linear_forward(beam, of=Even, slope=slope)
    prior = {name: dist.Normal(75.0, 10.0) for name in beam.parameter_names}
    observe = cal.nodal_displacements(beam, [3])
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.1), prior, check_scale=False)
    data = np.array([[0.0, slope, 0.0]])
    posterior = cal.sample(model, data, sampler="laplace", options=LaplaceOptions(draws=500))
    found = [line for line in posterior.warnings() if "another mode" in line]
    assert bool(found) is told
    if told:
        lower = posterior.tree.attrs["missed_mode_nats"]
        assert lower == pytest.approx((2.0 * slope / 0.1) ** 2 / 2.0, abs=0.5)
        assert posterior.tree.attrs["missed_mode"] in ("lam 75, mu 70", "lam 75, mu 80")


KEY = jax.random.key(0)
RNG = np.random.default_rng(0)


def density(log_density, size, spread=3.0):
    """A density given in unconstrained coordinates; its prior only gives the starts."""
    return Density(
        lambda z, data: log_density(z), size, size > 1, 1,
        lambda z: jnp.zeros(()),
        lambda z, data: log_density(z),
        lambda key: spread * jax.random.normal(key, (size,)),
        lambda z: {f"z{i}": z[:, i] for i in range(size)},
        lambda draw: jnp.stack(list(draw.values())),
        tuple(f"z{i}" for i in range(size)),
    )  # fmt: skip


def missed(log_density, draws):
    of = density(log_density, draws.shape[1])
    return missed_mode(of, {}, draws, find_modes(of, {}, prior_draws(of, KEY, 8), draws))


def test_draws_beside_modes_have_their_gaussians():
    """Correlated, against the closed form; of a slope that has no mode there are none."""
    covariance = np.array([[0.04, 0.03], [0.03, 0.09]])
    precision = jnp.asarray(np.linalg.inv(covariance))
    of = density(lambda z: -0.5 * (z - 1.0) @ precision @ (z - 1.0), 2)
    rng, modes = np.random.default_rng(0), Modes(np.ones((1, 2)), np.zeros(1))
    draws = draws_beside(of, {}, modes, 4000, rng)
    np.testing.assert_allclose(draws.mean(axis=0), 1.0, atol=0.02)
    np.testing.assert_allclose(np.cov(draws, rowvar=False), covariance, atol=0.005)
    beside = Modes(np.zeros((1, 2)), np.zeros(1))  # some sd down the slope
    assert draws_beside(of, {}, beside, 10, rng).shape == (0, 2)
    assert draws_beside(density(jnp.sum, 2), {}, modes, 10, rng).shape == (0, 2)


def two(weight, apart=4.0, width=0.5):
    """Gaussians at -apart and apart along the first of two coordinates; the second's share."""

    def log_density(z):
        centres = jnp.array([[-apart, 0.0], [apart, 0.0]])
        heights = Normal(centres, width).log_prob(z).sum(axis=1)
        return jax.nn.logsumexp(heights + jnp.log(jnp.array([1.0 - weight, weight])))

    first, second = (
        np.array([s * apart, 0.0]) + width * RNG.normal(size=(500, 2)) for s in (-1, 1)
    )
    return log_density, first, second


@pytest.mark.parametrize("weight", [0.5, 0.2, 0.9])
def test_a_mode_without_draws_is_reported_with_its_mass(weight):
    log_density, first, _ = two(weight)
    found = missed(log_density, first)
    # The mean log density is that of 64 draws, sd 1 / 8.
    assert found[MISSED_BY] == pytest.approx(np.log((1.0 - weight) / weight), abs=0.5)
    place = dict(part.split(" ") for part in found[MISSED_AT].split(", "))
    assert float(place["z0"]) == pytest.approx(4.0, abs=0.01)


def test_nothing_is_reported_where_both_have_draws_or_the_other_is_light():
    log_density, first, second = two(0.5)
    assert missed(log_density, np.concatenate([first, second])) == {MISSED_BY: np.inf}
    log_density, first, _ = two(0.01)
    assert missed(log_density, first) == {MISSED_BY: np.inf}


def test_a_valley_of_density_zero_is_one():
    """As where the forward map has no answer."""
    log_density, first, _ = two(0.5)
    ended = lambda z: jnp.where(jnp.abs(z[0]) < 1.0, -jnp.inf, log_density(z))
    assert missed(ended, first)[MISSED_BY] == pytest.approx(0.0, abs=0.5)


def funnel():
    depth = 3.0 * RNG.normal(size=2000)
    draws = np.stack([depth, np.exp(0.5 * depth) * RNG.normal(size=2000)], axis=1)
    return (
        lambda z: Normal(0.0, 3.0).log_prob(z[0]) + Normal(0.0, jnp.exp(0.5 * z[0])).log_prob(z[1]),
        draws,
    )


def bent_ridge():
    x = RNG.normal(size=2000)
    draws = np.stack([x, x**2 + 0.1 * RNG.normal(size=2000)], axis=1)
    return lambda z: Normal(0.0, 1.0).log_prob(z[0]) + Normal(z[0] ** 2, 0.1).log_prob(z[1]), draws


def gaussian(size):
    sd = np.geomspace(1e-3, 1.0, size)
    return lambda z: Normal(0.0, sd).log_prob(z).sum(), RNG.normal(size=(1000, size)) * sd


def ended():
    """A Gaussian that ends at one sd: no mode inside, and a wall."""
    draws = RNG.normal(size=(4000, 2))
    return lambda z: jnp.where(z[0] > 1.0, Normal(0.0, 1.0).log_prob(z).sum(), -jnp.inf), draws[
        draws[:, 0] > 1.0
    ]


@pytest.mark.parametrize(
    "case", [funnel(), bent_ridge(), gaussian(1), gaussian(8), gaussian(20), ended()]
)
def test_one_mode_of_any_shape_is_not_two(case):
    assert missed(*case) == {MISSED_BY: np.inf}


def test_where_the_density_is_zero_everywhere_nothing_is_found():
    assert missed(lambda z: jnp.full((), -jnp.inf), RNG.normal(size=(50, 2))) == {MISSED_BY: np.inf}


def test_draws_that_do_not_vary_are_left_to_other_checks():
    log_density, _, _ = two(0.5)
    assert missed(log_density, np.zeros((50, 2))) == {MISSED_BY: np.inf}


@pytest.mark.parametrize(
    ("nats", "mass"), [(0.7, "0.5 times"), (-0.7, "2 times"), (-900.0, "many")]
)
def test_the_sentence_names_place_and_mass(nats, mass):
    attributes = {MISSED_BY: nats, MISSED_AT: "mu 71.3"}
    summary = {"mu": {"r_hat": 1.0, "ess_bulk": 1e4, "ess_tail": 1e4}}
    (sentence,) = diagnose({}, {}, summary, attributes)
    assert "mu 71.3" in sentence
    assert f"has {mass}" in sentence
