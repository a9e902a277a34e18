"""A population of one parameter from draws of its members, against quadrature of the exact model.

Members' likelihoods are normals and pairs of normals on the scale of mu, their draws exact, so that
the posterior of median and sd is an integral over a plane.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

import calibrate as cal
from calibrate.population import mixtures, population_model, sample, second_stage
from calibrate.population.density import density_of_population
from calibrate.population.second_stage import as_many, under_population
from calibrate.samplers import NUTSOptions
from calibrate.samplers.protocol import Context
from emulator.core.errors import SolverError
from linear_support import linear_forward

OPTIONS = NUTSOptions(warmup=300, draws=750, chains=2, rounds=1)
LOW, HIGH = np.log(50.0), np.log(100.0)
# Two humps each: means and sds on the scale of ln mu, and the share of the first.
MEMBERS = {
    "a": ((4.15, 0.02), (4.15, 0.02), 1.0),
    "b": ((4.25, 0.03), (4.50, 0.02), 0.6),
    "c": ((4.22, 0.08), (4.22, 0.08), 1.0),
    "d": ((4.05, 0.04), (4.40, 0.04), 0.3),
}


def log_likelihood(member, x):
    *humps, share = MEMBERS[member]
    heights = [
        np.log(s + 1e-300) - 0.5 * ((x - m) / sd) ** 2 - np.log(sd)
        for (m, sd), s in zip(humps, (share, 1.0 - share), strict=True)
    ]
    return logsumexp(heights, axis=0)


@pytest.fixture(scope="module")
def model(beam):
    forward, observe = linear_forward(beam), cal.nodal_displacements(beam, [3, 11, 20])
    member = cal.model(
        forward, observe, cal.GaussianNoise(sd=0.1), check_scale=False, known={"lam": 75.0}
    )
    return population_model(dict.fromkeys(MEMBERS, member))


@pytest.fixture(scope="module")
def draws():
    """Exact draws of each member under the log-uniform prior of its range."""
    rng, grid = np.random.default_rng(0), np.linspace(LOW, HIGH, 20_001)
    found = {}
    for member in MEMBERS:
        share = np.cumsum(np.exp(log_likelihood(member, grid)))
        at = np.searchsorted(share / share[-1], rng.uniform(size=2000))
        found[member] = {"mu": np.exp(grid[at.clip(max=20_000)])}
    return found


@pytest.fixture(scope="module")
def exact(model):
    """Mean and sd of the median, and of the sd, by quadrature."""
    density = density_of_population(model)
    line = np.linspace(-6.0, 6.0, 81)
    z = jnp.asarray(np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2))
    some, x = density.constrain(z), jnp.linspace(LOW, HIGH, 1001)[1:-1]
    flat = mixtures.Mixtures(np.zeros((1, 1)), *(np.zeros((1, 1, *(1,) * k)) for k in range(3)))
    log_prior = jax.jit(jax.vmap(lambda z: density.log_density(z, flat)))(z)
    low, high = ((end - jnp.log(some.median)) / some.sd for end in (LOW, HIGH))
    mass = jax.scipy.special.ndtr(high) - jax.scipy.special.ndtr(low)
    log_prior = np.asarray(log_prior + jnp.log(mass)[:, 0])  # the flat member's cut
    of_x = jax.jit(lambda some: jax.lax.map(lambda p: model.log_density(x[:, None], p), some))
    of_x = np.asarray(of_x(some))
    heights = log_prior + sum(
        logsumexp(of_x + log_likelihood(member, np.asarray(x)), axis=1) for member in MEMBERS
    )
    weight = np.exp(heights - heights.max())
    weight /= weight.sum()
    found = []
    for values in (np.asarray(some.median)[:, 0], np.asarray(some.sd)[:, 0]):
        mean = weight @ values
        found.append((mean, np.sqrt(weight @ (values - mean) ** 2)))
    return found


def close(model, stage, exact):
    density, rows = density_of_population(model), stage.rows(0)
    z = jnp.asarray(stage.draws.z.reshape(-1, density.dimension)[rows])
    some = density.constrain(z)
    for values, (mean, sd) in zip((some.median, some.sd), exact, strict=True):
        assert float(values.mean()) == pytest.approx(mean, abs=0.15 * sd)
        assert float(values.std()) == pytest.approx(sd, rel=0.1)


def staged(model, draws, members=None):
    density = density_of_population(model)
    members = model.members if members is None else members
    return second_stage.second_stage(model, density, members, draws, OPTIONS, Context(seed=1))


def test_it_is_that_of_quadrature(model, draws, exact):
    stage = staged(model, draws)
    assert stage.weighs
    assert stage.share > 0.9
    close(model, stage, exact)


def test_draws_mend_a_wrong_mixture(model, draws, exact, monkeypatch):
    """One normal for each member in place of two humps: weights say so, and are enough."""
    monkeypatch.setattr(mixtures, "_MOST_PARTS", 1)
    stage = staged(model, draws)
    assert stage.weighs
    assert stage.share < 0.9
    close(model, stage, exact)


def test_a_mixture_that_is_elsewhere_is_refused(model, draws, monkeypatch):
    """Of members whose likelihoods are four sds of the population off: the draws cannot weigh."""
    right = second_stage.likelihood_of

    def wrong(x, log_prior, prior, rng):
        return right(x + 0.25, log_prior, prior, rng)

    monkeypatch.setattr(second_stage, "likelihood_of", wrong)
    stage = staged(model, draws)
    assert not stage.weighs
    np.testing.assert_array_equal(stage.rows(0), np.arange(1500))


def test_members_again_under_the_population_are_the_same(model, draws, exact):
    """Their prior is another, their weights are over it: the population is the same."""
    density, few = density_of_population(model), as_many(draws)
    members = under_population(model, density, staged(model, few))
    prior = members["a"].prior["mu"]
    assert members["a"].boxed == frozenset()
    assert members["a"] is members["d"]  # one model, one program
    rng, grid = np.random.default_rng(1), np.linspace(LOW, HIGH, 20_001)[1:-1]
    log_prior = np.asarray(prior.log_prob(jnp.exp(grid))) + grid
    again = {}
    for member in MEMBERS:
        share = np.cumsum(np.exp(log_likelihood(member, grid) + log_prior))
        at = np.searchsorted(share / share[-1], rng.uniform(size=2000))
        again[member] = {"mu": np.exp(grid[at.clip(max=len(grid) - 1)])}
    stage = staged(model, again, members)
    assert stage.weighs
    close(model, stage, exact)


def test_members_that_cannot_be_sampled_again_keep_their_draws(model, draws, monkeypatch):
    """One fails, the chains of another disagree: told, and no end of the others."""
    few = {name: {"mu": of["mu"][::100]} for name, of in draws.items()}
    apart = {"mu": np.stack([np.linspace(60.0, 61.0, 20), np.linspace(80.0, 81.0, 20)])}
    asked = []

    def sampled(member, data, sampler, seed, *, progress):
        asked.append(seed)
        if len(asked) % 2:
            raise SolverError("it has no answer")
        return apart

    monkeypatch.setattr(sample, "_draws", sampled)
    data = {name: {} for name in MEMBERS}
    options = NUTSOptions(warmup=100, draws=100, chains=2, rounds=1)
    found = sample.sample_population(model, data, options=options, alone=few, seed=0)
    assert len(asked) == len(MEMBERS)
    assert found.tree.attrs["member_rounds"] == 2
    assert found.tree.attrs["log_likelihood_error"] > second_stage.LARGEST_ERROR
    assert np.isin(found.member("a")["mu"], few["a"]["mu"]).all()
    (sentence,) = [s for s in found.warnings() if "the population rests on" in s]
    assert "take more draws of each" in sentence


def test_as_many_draws_of_each_member_as_the_fewest_have():
    draws = {"a": {"mu": np.arange(8.0).reshape(2, 4)}, "b": {"mu": np.arange(3.0)}}
    found = as_many(draws)
    np.testing.assert_array_equal(found["a"]["mu"], [0.0, 3.0, 7.0])
    np.testing.assert_array_equal(found["b"]["mu"], [0.0, 1.0, 2.0])
