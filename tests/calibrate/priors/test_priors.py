"""Priors against scipy, and against the range in which a forward map answers."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

import calibrate as cal
from calibrate.priors.priors import Truncated
from calibrate.provenance import describe_distribution
from calibrate.statistical_model.prior_range import standardised
from emulator.core.errors import InputError
from emulator.surrogates.fem import fem_forward
from emulator.surrogates.protocol import inside_only
from linear_support import LinearForward, closed_form, linear_forward

NOISE = cal.GaussianNoise(sd=0.1)


@dataclass(frozen=True, eq=False)
class BoxForward(LinearForward):
    """Like an emulator: valid in the scene's box only."""

    def evaluate(self, theta):
        return inside_only(self, theta)


@pytest.fixture(scope="module")
def bounded(beam):
    return linear_forward(beam, of=BoxForward)


def model_with(forward, beam, mu):
    prior = {**cal.priors.box_prior(beam), "mu": mu}
    return cal.model(forward, cal.nodal_displacements(beam, [3, 11]), NOISE, prior)


@pytest.mark.parametrize(
    ("mu", "mass"),
    [
        (dist.Uniform(50.0, 150.0), "50 %"),
        (dist.Normal(75.0, 20.0), "21 %"),
        (dist.HalfNormal(80.0), "68 %"),
        (dist.LogNormal(4.3, 0.3), "25 %"),
        (dist.Gamma(25.0, 0.33), "9.5 %"),
        (dist.LogUniform(10.0, 100.0), "70 %"),
    ],
)
def test_a_prior_wider_than_the_box_is_refused_in_one_line(bounded, beam, mu, mass):
    with pytest.raises(InputError) as caught:
        model_with(bounded, beam, mu)
    said = str(caught.value)
    assert said.startswith(f"prior of 'mu' has {mass} of its mass outside 50 to 100 kPa")
    assert "truncated(prior, scene)" in said
    assert "wider range" in said
    assert "\n" not in said


def test_a_negligible_mass_is_cut_off_and_recorded(bounded, beam):
    model = model_with(bounded, beam, dist.Normal(75.0, 7.0))
    outside = 2.0 * stats.norm.cdf(-25.0 / 7.0)
    assert dict(model.prior_cut) == {"mu": pytest.approx(outside, rel=1e-6)}
    assert "low=50.0, high=100.0, base=Normal" in describe_distribution(model.prior["mu"])
    assert model_with(bounded, beam, dist.Uniform(60.0, 90.0)).prior_cut == {}


@pytest.mark.slow
def test_a_prior_cut_by_request_is_sampled(bounded, beam):
    """Half of the normal's mass lies above the box."""
    prior = cal.priors.truncated(
        {**cal.priors.box_prior(beam), "mu": dist.Normal(100.0, 5.0)}, beam
    )
    model = cal.model(bounded, cal.nodal_displacements(beam, [3]), cal.GaussianNoise(sd=1e3), prior)
    assert model.prior_cut == {}
    data = np.asarray(model.forward(jnp.array([90.0, 70.0])))
    posterior = cal.sample(
        model, data, options=cal.samplers.NUTSOptions(200, 500, rounds=2), seed=1
    )
    draws = posterior.draws()["mu"]
    assert draws.max() <= 100.0
    # Such noise says nothing: half-normal, mean 100 - 5 sqrt(2 / pi).
    ess = posterior.summary()["mu"]["ess_bulk"]
    assert draws.mean() == pytest.approx(100.0 - 5.0 * np.sqrt(2 / np.pi), abs=4 * 3.0 / ess**0.5)


@pytest.mark.slow
def test_a_map_without_a_box_takes_any_prior_and_chains_start(beam):
    """Before, NumPyro looked for starting points near 0 and gave up."""

    class Positive(LinearForward):
        def evaluate(self, theta):
            found = super().evaluate(theta)
            return found._replace(valid=jnp.all((theta > 5.0) & (theta < 500.0)))

    forward = linear_forward(beam, of=Positive)
    prior = {"mu": dist.Normal(120.0, 20.0), "lam": dist.Gamma(100.0, 1.4)}
    model = cal.model(forward, cal.nodal_displacements(beam, [3, 11]), NOISE, prior)
    assert model.prior_cut == {}
    data = np.asarray(model.forward(jnp.array([115.0, 60.0])))
    posterior = cal.sample(
        model, data, options=cal.samplers.NUTSOptions(200, 200, chains=2, rounds=1)
    )
    table = posterior.summary()
    for name, truth in (("mu", 115.0), ("lam", 60.0)):
        assert abs(table[name]["mean"] - truth) < 4.0 * table[name]["sd"]
        assert table[name]["sd"] < 10.0


@pytest.mark.slow
def test_the_posterior_beyond_the_box_is_the_known_one(beam):
    """Truth 100.3 in a box that ends at 100: the posterior must reach beyond it."""
    forward = linear_forward(beam)
    observe = cal.nodal_displacements(beam, [3, 11, 20])
    mean, sd = np.array([100.0, 70.0]), np.array([20.0, 10.0])
    prior = {n: dist.Normal(m, s) for n, m, s in zip(beam.parameter_names, mean, sd, strict=True)}
    model = cal.model(forward, observe, NOISE, prior)
    data = np.asarray(model.forward(jnp.array([100.3, 70.0])))
    posterior = cal.sample(model, data, options=cal.samplers.NUTSOptions(200, 500, rounds=2))
    known, covariance = closed_form(forward, observe.nodes, data, 0.1, mean, sd)
    draws, ess = posterior.draws()["mu"], posterior.summary()["mu"]["ess_bulk"]
    assert abs(draws.mean() - known[0]) < 4 * np.sqrt(covariance[0, 0] / ess)
    assert (draws > 100.0).mean() > 0.4


def test_fem_answers_outside_the_box(beam, simulator):
    model = model_with(fem_forward(simulator), beam, dist.Normal(75.0, 15.0))
    assert model.prior_cut == {}
    assert model.prior["mu"].scale == 15.0


@pytest.mark.slow
def test_fem_with_a_normal_prior_in_the_sampler(beam, simulator):
    nodes = beam.mesh.node_set("right")
    prior = {"mu": dist.Normal(110.0, 15.0), "lam": dist.Normal(70.0, 10.0)}
    observe = cal.nodal_displacements(beam, nodes)
    model = cal.model(fem_forward(simulator), observe, cal.GaussianNoise(sd=0.05), prior)
    data = np.asarray(simulator(jnp.array([112.0, 70.0]))[nodes])
    posterior = cal.sample(
        model, data, options=cal.samplers.NUTSOptions(15, 15, chains=2, rounds=1)
    )
    draws = posterior.draws()["mu"]
    assert abs(draws.mean() - 112.0) < 15.0
    assert draws.max() > 100.0


# ---- densities --------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (cal.priors.truncated_normal(3.0, 2.0, 1.0, 4.0), stats.truncnorm(-1.0, 0.5, 3.0, 2.0)),
        (cal.priors.truncated_normal(3.0, 2.0, low=1.0), stats.truncnorm(-1.0, np.inf, 3.0, 2.0)),
        (cal.priors.log_normal(5.0, 0.3), stats.lognorm(0.3, scale=5.0)),
    ],
)
def test_constructors_against_scipy(ours, theirs):
    x = np.linspace(1.1, 3.9, 7)
    np.testing.assert_allclose(ours.log_prob(x), theirs.logpdf(x), rtol=1e-10)


@pytest.mark.parametrize(
    ("base", "theirs"),
    [
        (dist.LogNormal(1.0, 0.5), stats.lognorm(0.5, scale=np.e)),
        (dist.Gamma(3.0, 1.0), stats.gamma(3.0)),
        (dist.HalfNormal(3.0), stats.halfnorm(scale=3.0)),
    ],
)
def test_a_truncated_distribution_against_scipy(base, theirs):
    cut = Truncated(base, 1.0, 4.0)
    mass = theirs.cdf(4.0) - theirs.cdf(1.0)
    x = np.array([1.0, 2.0, 3.3])
    np.testing.assert_allclose(cut.log_prob(x), theirs.logpdf(x) - np.log(mass), rtol=1e-8)
    assert cut.log_prob(4.1) == -np.inf
    np.testing.assert_allclose(
        cut.icdf(np.array([0.1, 0.7])), theirs.ppf(theirs.cdf(1.0) + mass * np.array([0.1, 0.7])),
        rtol=1e-6,
    )  # fmt: skip
    draws = np.asarray(cut.sample(jax.random.key(0), (2000,)))
    result = stats.kstest(draws, lambda v: (theirs.cdf(v) - theirs.cdf(1.0)) / mass)
    assert result.pvalue > 1e-3


def test_log_normal_is_cut_where_asked():
    cut = cal.priors.log_normal(70.0, 0.2, low=50.0, high=100.0)
    assert np.isinf(cut.log_prob(49.0))
    assert np.isfinite(cut.log_prob(50.1))
    assert np.isfinite(cal.priors.log_normal(70.0, 0.2, low=50.0).log_prob(200.0))


def test_standardised_coordinates_change_no_density():
    wide = cal.priors.log_normal(2.2, 1.55, low=0.007, high=710.0)
    for prior in (dist.Normal(75.0, 3.0), dist.LogNormal(4.0, 0.1), wide):
        around = standardised(prior)
        x = prior.sample(jax.random.key(1), (5,))
        np.testing.assert_array_equal(around.log_prob(x), prior.log_prob(x))
        z = dist.biject_to(around.support).inv(prior.sample(jax.random.key(2), (4000,)))
        assert abs(float(jnp.mean(z))) < 0.2
        assert float(jnp.std(z)) == pytest.approx(1.0, abs=0.1)
    box = dist.Uniform(1.0, 2.0)
    assert standardised(box) is box


@pytest.mark.parametrize(
    "prior",
    [
        cal.priors.log_normal(2.2, 1.55, low=0.007, high=710.0),
        cal.priors.log_normal(11.5, 1.6),
        cal.priors.truncated_normal(1e4, 10.0, 0.0, 1e9),
        dist.LogUniform(1e-4, 1e4),
        dist.Beta(2.0, 200.0),
        dist.Uniform(-3.0, 1e6),
    ],
)
def test_samplers_start_where_the_prior_is(prior):
    """Chains start within two units of 0 in each coordinate."""
    low, middle, high = dist.biject_to(standardised(prior).support)(jnp.array([-2.0, 0.0, 2.0]))
    draws = np.asarray(prior.sample(jax.random.key(3), (4000,)))
    below = [float(np.mean(draws < value)) for value in (low, middle, high)]
    assert 0.0 < below[0] < 0.15
    assert below[1] == pytest.approx(0.5, abs=0.05)
    assert 0.85 < below[2] < 1.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: cal.priors.truncated_normal(1.0, 0.0), "sd is 0.0"),
        (lambda: cal.priors.truncated_normal(1.0, 1.0, 3.0, 2.0), "no value lies between 3 and 2"),
        (lambda: cal.priors.log_normal(-1.0, 1.0), "median is -1.0"),
        (lambda: cal.priors.log_normal(1.0, 1.0, low=3.0, high=2.0), "no value lies between"),
    ],
)
def test_constructors_refuse_what_makes_no_sense(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_a_prior_entirely_outside_the_box(beam):
    prior = {**cal.priors.box_prior(beam), "mu": dist.Uniform(200.0, 300.0)}
    with pytest.raises(InputError, match="prior Uniform lies outside 50 to 100"):
        cal.priors.truncated(prior, beam)


@pytest.mark.parametrize(
    ("base", "low", "high"),
    [
        (dist.Normal(1.0, 0.5), 6.0, 7.0),
        (dist.Normal(1.0, 0.5), -5.0, -4.0),
        (dist.StudentT(4.0, 1.0, 0.5), 6.0, 7.0),
        (dist.LogNormal(0.0, 0.3), 20.0, 40.0),
    ],
)
def test_a_tail_of_a_distribution_has_a_finite_density_that_integrates_to_one(base, low, high):
    """Ten sds away, where the cumulative distribution function is 1 to round-off."""
    tail = Truncated(base, low, high)
    x = np.linspace(low, high, 20_001)
    density = np.exp(np.asarray(tail.log_prob(x)))
    assert np.trapezoid(density, x) == pytest.approx(1.0, rel=1e-4)
    np.testing.assert_allclose(tail.cdf(jnp.array([low, high])), [0.0, 1.0], atol=1e-12)
    quantile = float(tail.icdf(jnp.array(0.5)))
    assert np.trapezoid(density[x <= quantile], x[x <= quantile]) == pytest.approx(0.5, abs=2e-3)
