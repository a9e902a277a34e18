"""Tempered SMC: several modes, and the evidence, against closed forms and quadrature."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy.stats import multivariate_normal

import calibrate as cal
from calibrate.samplers import SMCOptions, density_of
from calibrate.samplers.smc import _increment, evidence
from emulator.core.errors import InputError, SolverError
from linear_support import PRIOR_MEAN, PRIOR_SD, linear_forward, linear_problem, share_and_evidence


@pytest.mark.slow
def test_two_modes_that_nuts_gets_wrong_have_their_shares(two_modes):
    model, data = two_modes
    share, log_evidence = share_and_evidence()
    assert share == pytest.approx(0.38, abs=0.01)
    posterior = cal.sample(model, data, sampler="smc", seed=1)
    upper = (posterior.tree["posterior"]["mu"].values > 75).mean(axis=1)
    # Populations of 1000 particles; resampling adds to the binomial error.
    np.testing.assert_allclose(upper, share, atol=6 * np.sqrt(share * (1 - share) / 1000))
    assert upper.mean() == pytest.approx(share, abs=0.03)
    assert posterior.summary()["mu"]["r_hat"] < 1.02
    attributes = posterior.tree.attrs
    assert attributes["log_evidence"] == pytest.approx(log_evidence, abs=0.1)
    assert 0.0 < attributes["log_evidence_error"] < 0.1

    stuck = cal.sample(model, data, options=cal.samplers.NUTSOptions(300, 300, rounds=2), seed=1)
    upper = (stuck.tree["posterior"]["mu"].values > 75).mean(axis=1)
    assert set(upper) <= {0.0, 1.0}
    assert stuck.summary()["mu"]["r_hat"] > 1.5


def test_the_evidence_of_a_linear_gaussian_model_is_the_known_one(beam):
    model, data = linear_problem(beam)
    A = model.forward.matrix.reshape(-1, 2)
    mean = A @ PRIOR_MEAN + model.forward.shift.ravel()
    covariance = 0.1**2 * np.eye(9) + A @ np.diag(PRIOR_SD**2) @ A.T
    expected = multivariate_normal(mean, covariance).logpdf(data.ravel())
    posterior = cal.sample(model, data, sampler="smc", seed=3)
    error = posterior.tree.attrs["log_evidence_error"]
    assert error < 0.1
    # Student's t with 3 degrees of freedom: 5.8 standard errors are its 99 % interval.
    assert posterior.tree.attrs["log_evidence"] == pytest.approx(expected, abs=5.8 * error)


def test_prior_and_likelihood_make_the_density(beam):
    """Of a bounded prior and an inferred noise too, whose coordinates have a Jacobian."""
    model = cal.model(
        linear_forward(beam), cal.nodal_displacements(beam, [3]), cal.GaussianNoise(sd_scale=1.0)
    )
    data = model.check_data(np.ones((1, 3)))
    density = density_of(model)
    z = jnp.array([0.3, -0.7, 0.2])
    total = density.log_prior(z) + density.log_likelihood(z, data)
    assert float(total) == pytest.approx(float(density.log_density(z, data)), rel=1e-12)
    # The prior's density of z integrates to 1, and its draws are draws of it.
    draws = np.asarray(jax.vmap(density.prior_draw)(jax.random.split(jax.random.key(0), 4000)))
    grid = np.stack(np.meshgrid(*[np.linspace(-12, 12, 49)] * 3, indexing="ij"), -1).reshape(-1, 3)
    mass = np.exp(np.asarray(jax.vmap(density.log_prior)(jnp.asarray(grid)))) * 0.5**3
    assert mass.sum() == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(
        draws.mean(axis=0), mass @ grid, atol=4 * draws.std(axis=0).max() / np.sqrt(4000)
    )


@pytest.mark.slow
def test_particles_die_out_where_the_map_has_no_answer(beam):
    forward = replace(linear_forward(beam), limit=75.0)
    prior = {name: dist.Uniform(60.0, 80.0) for name in beam.parameter_names}
    model = cal.model(
        forward, cal.nodal_displacements(beam, [3]), cal.GaussianNoise(sd=10.0), prior
    )
    options = SMCOptions(draws=200, chains=2)
    posterior = cal.sample(model, np.zeros((1, 3)), sampler="smc", options=options)
    assert max(values.max() for values in posterior.draws().values()) < 75.0
    assert np.isfinite(posterior.tree["sample_stats"]["lp"].values).all()
    # The data says nothing, so the evidence is the likelihood times the valid prior mass, 9/16.
    likelihood = -3 * np.log(10.0 * np.sqrt(2 * np.pi))
    expected = likelihood + np.log(9 / 16)
    assert posterior.tree.attrs["log_evidence"] == pytest.approx(expected, abs=0.2)


def test_a_step_leaves_the_wanted_effective_sample_size():
    heights = jnp.asarray(np.random.default_rng(0).normal(size=1000) * 50.0)
    step = float(_increment(heights, jnp.asarray(1.0), 0.6))
    weights = np.exp(step * (np.asarray(heights) - np.asarray(heights).max()))
    assert weights.sum() ** 2 / (weights**2).sum() == pytest.approx(600, rel=1e-3)
    assert float(_increment(0.0 * heights, jnp.asarray(0.4), 0.6)) == pytest.approx(0.4)


def test_the_mean_evidence_is_not_that_of_logarithms():
    found = evidence(np.log([1.0, 3.0]) - 800.0)
    assert found["log_evidence"] == pytest.approx(np.log(2.0) - 800.0)
    assert found["log_evidence_error"] == pytest.approx(1.0 / 2.0)  # sd sqrt(2), of two, mean 2
    assert evidence(np.array([-3.0])) == {"log_evidence": -3.0}


def test_what_cannot_work(beam):
    with pytest.raises(InputError, match="SMC: survivors is 1.0; give one in"):
        SMCOptions(survivors=1.0)
    model, data = linear_problem(beam)
    with pytest.raises(SolverError, match="SMC: a population is at temperature .* after 1 steps"):
        cal.sample(model, data, sampler="smc", options=SMCOptions(draws=50, temperatures=1))
