"""Joint priors against closed forms, in models, and on the command line."""

import json
from dataclasses import asdict

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

import calibrate as cal
from calibrate.posterior import predictions
from calibrate.priors import Dependence, JointPrior
from calibrate.priors.population import POPULATIONS, prior_of
from calibrate.priors.priors import Conditional
from calibrate.project import Run
from calibrate.statistical_model.density import density_of
from emulator.core.errors import InputError
from emulator.core.schema import read_json_as
from emulator.scenes.built_in.ventricles import left_ventricle
from linear_support import linear_forward

NOISE = cal.GaussianNoise(sd=0.1)
HALF = np.array([[1.0, -0.8], [-0.8, 1.0]])


def model_of(beam, prior, **more):
    return cal.model(
        linear_forward(beam), cal.nodal_displacements(beam, [3, 11]), NOISE, prior, **more
    )


def log_normals(scale=0.1):
    return {
        "mu": cal.priors.log_normal(75.0, scale),
        "lam": cal.priors.log_normal(70.0, 2.0 * scale),
    }


def log_prior_of(model, **values):
    """Log density of the joint prior in theta, from the sites a model declares."""
    total, draw = 0.0, {}
    for name in model.states.unknowns:
        prior = model.given_earlier(name, model.prior[name], draw)
        draw[name] = jnp.asarray(values[name])
        total += float(prior.log_prob(draw[name]))
    return total


def test_correlated_log_normals_are_a_normal_of_logarithms(beam):
    model = model_of(beam, JointPrior(log_normals(), Dependence(("mu", "lam"), HALF)))
    sd = np.array([0.1, 0.2])
    exact = stats.multivariate_normal(np.log([75.0, 70.0]), HALF * sd[:, None] * sd)
    for mu, lam in [(75.0, 70.0), (60.0, 95.0), (90.0, 80.0)]:
        expected = exact.logpdf(np.log([mu, lam])) - np.log(mu * lam)
        assert log_prior_of(model, mu=mu, lam=lam) == pytest.approx(expected, abs=1e-9)


def test_cut_to_a_range_its_density_is_normalised(beam):
    prior = cal.priors.truncated(
        JointPrior(log_normals(0.2), Dependence(("lam", "mu"), HALF)), beam
    )  # names in another order than theta's
    assert isinstance(prior, JointPrior)
    model = model_of(beam, prior)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    low, high = zip(*((p.low, p.high) for p in beam.parameters), strict=True)
    x, y = (0.5 * (a + b) + 0.5 * (b - a) * nodes for a, b in zip(low, high, strict=True))
    names = model.states.unknowns

    def given(value):
        mean, sd = model.dependence.given_earlier(names[1], model.prior, {names[0]: value})
        second = model.prior[names[1]]
        return jax.vmap(Conditional(second, mean, sd, second.support).log_prob)(y)

    @jax.jit
    def joint(x):
        return jnp.exp(jax.vmap(model.prior[names[0]].log_prob)(x)[:, None] + jax.vmap(given)(x))

    density = joint(x)
    area = 0.25 * np.prod(np.subtract(high, low))
    assert area * weights @ density @ weights == pytest.approx(1.0, abs=2e-3)


def test_draws_have_marginals_and_correlation(beam):
    prior = cal.priors.truncated(
        JointPrior(log_normals(0.2), Dependence(("mu", "lam"), HALF)), beam
    )
    model = model_of(beam, prior)
    direct = model.prior_draws(jax.random.key(0), 4000)
    traced = predictions.prior_replicates(model, jax.random.key(1), 4000).draws
    for draws in (direct, traced):
        for name in ("mu", "lam"):
            assert stats.kstest(np.asarray(draws[name]), prior[name].cdf).pvalue > 1e-3
        # A Gaussian copula's rank correlation is 6/pi asin(rho/2).
        rank = stats.spearmanr(draws["mu"], draws["lam"]).statistic
        assert rank == pytest.approx(6.0 / np.pi * np.arcsin(-0.4), abs=0.03)


@pytest.mark.slow
def test_nuts_meets_the_closed_form_posterior(beam):
    """A linear map, a Gaussian joint prior: the posterior is normal."""
    sd = np.array([5.0, 8.0])
    marginals = {"mu": dist.Normal(75.0, sd[0]), "lam": dist.Normal(70.0, sd[1])}
    model = model_of(beam, JointPrior(marginals, Dependence(("mu", "lam"), HALF)))
    names = list(model.states.unknowns)
    order = ["mu", "lam"]
    data = {n: np.asarray(v) for n, v in model.predict({"mu": 78.0, "lam": 66.0})[0].items()}
    flat = lambda x: jnp.concatenate(
        [jnp.ravel(v) for v in model.predict(dict(zip(order, x, strict=True)))[0].values()]
    )
    J = np.asarray(jax.jacfwd(flat)(jnp.array([75.0, 70.0])))
    precision = J.T @ J / NOISE.sd**2 + np.linalg.inv(HALF * sd[:, None] * sd)
    gap = np.concatenate([np.ravel(v) for v in data.values()]) - np.asarray(
        flat(jnp.array([75.0, 70.0]))
    )
    mean = np.array([75.0, 70.0]) + np.linalg.solve(precision, J.T @ gap / NOISE.sd**2)
    covariance = np.linalg.inv(precision)
    options = cal.samplers.NUTSOptions(warmup=300, draws=500, chains=2)
    draws = cal.sample(model, data, options=options, seed=1, predictions=False).draws()
    table = np.stack([draws[name] for name in order], axis=1)
    found = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((table.mean(axis=0) - mean) / found, 0.0, atol=0.2)
    np.testing.assert_allclose(table.std(axis=0) / found, 1.0, atol=0.15)
    assert set(names) == set(order)


@pytest.mark.slow
def test_density_and_draws_of_the_prior_agree(beam):
    """E_prior of score is zero: the density the samplers see is the one the draws come from."""
    prior = cal.priors.truncated(
        JointPrior(log_normals(0.2), Dependence(("mu", "lam"), HALF)), beam
    )
    density = density_of(model_of(beam, prior))
    z = jax.vmap(density.prior_draw)(jax.random.split(jax.random.key(2), 4000))
    gradients = np.asarray(jax.vmap(jax.grad(density.log_prior))(z))
    assert np.isfinite(gradients).all()
    errors = gradients.std(axis=0) / np.sqrt(len(z))
    np.testing.assert_array_less(np.abs(gradients.mean(axis=0)), 4.0 * errors)


@pytest.mark.parametrize(
    ("names", "matrix", "said"),
    [
        (("mu", "lam"), np.eye(3), "one row for each"),
        (("mu", "mu"), np.eye(2), "named once"),
        (("mu", "lam"), [[1.0, 0.5], [0.4, 1.0]], "not symmetric"),
        (("mu", "lam"), [[1.0, 1.0], [1.0, 1.0]], "not positive definite"),
        (("mu", "nu"), HALF, "'nu', which is not inferred"),
    ],
)
def test_what_is_no_correlation_is_refused(names, matrix, said):
    with pytest.raises(InputError, match=said):
        JointPrior(log_normals(), Dependence(names, matrix))


def test_a_known_parameter_has_no_prior(beam):
    with pytest.raises(InputError, match="known and has a prior"):
        model_of(beam, JointPrior(log_normals(), Dependence(("mu", "lam"), HALF)), known={"mu": 75})


def test_provenance_names_the_correlation(beam):
    model = model_of(beam, JointPrior(log_normals(), Dependence(("mu", "lam"), HALF)))
    from calibrate.posterior.posterior import provenance

    found = provenance(model, 0, "nuts", cal.samplers.NUTSOptions())["prior_dependence"]
    assert found == {"names": list(model.states.unknowns), "correlation": HALF.tolist()}


def test_the_population_of_fits_is_found_again():
    rng = np.random.default_rng(0)
    logs = rng.multivariate_normal([0.0, 1.0], 0.04 * HALF, 2000).T
    found = cal.priors.population_of_fits({"a": np.exp(logs[0]), "a_f": np.exp(logs[1])}, "made up")
    assert found.median == pytest.approx({"a": 1.0, "a_f": np.e}, rel=0.02)
    assert found.log_sd == pytest.approx({"a": 0.2, "a_f": 0.2}, rel=0.06)
    assert found.correlation == pytest.approx({"a,a_f": -0.8}, abs=0.03)
    with pytest.raises(InputError, match="4 subjects or more"):
        cal.priors.population_of_fits({"a": [1.0, 2.0, 3.0], "b": [1.0, 2.0, 2.5]})


def test_the_default_ventricles_fit_the_scene():
    scene = left_ventricle(rings=4, around=8, layers=1, order=1)
    population = POPULATIONS["ventricles"]
    prior = population.prior(scene)
    assert set(prior) == {"a", "b", "a_f", "b_f"}  # the pressure keeps the box
    for parameter in scene.parameters[:4]:
        # Their range is the box, as two sd on each side.
        assert population.median[parameter.name] == pytest.approx(
            np.sqrt(parameter.low * parameter.high), rel=0.01
        )
        spread = np.log(parameter.high / parameter.low) / 4.0
        assert population.log_sd[parameter.name] == pytest.approx(spread, rel=0.01)


def test_a_run_takes_names_files_and_numbers(tmp_path, beam):
    numbers = asdict(
        cal.priors.Population({"mu": 75.0, "lam": 70.0}, {"mu": 0.1, "lam": 0.2}, {"mu,lam": 0.5})
    )
    path = tmp_path / "cohort.json"
    path.write_text(json.dumps(numbers))
    assert asdict(read_json_as(cal.priors.Population, path)) == numbers
    assert Run("once_clamped_beam", prior=numbers).prior == numbers
    found = prior_of(numbers, beam)
    assert found.dependence.correlation[0, 1] == 0.5
    assert prior_of("box", beam) is None
    with pytest.raises(InputError, match="known: box, ventricles"):
        prior_of("hearts", beam)
    with pytest.raises(InputError, match="the population is of 'a'"):
        prior_of("ventricles", beam)
    path.write_text(json.dumps({**numbers, "correlation": {"mu,nu": 0.5}}))
    with pytest.raises(InputError, match="correlation 'mu,nu': give two of mu, lam"):
        read_json_as(cal.priors.Population, path)


@pytest.mark.slow
def test_the_command_line_keeps_the_prior(tmp_path):
    from calibrate.cli import main
    from calibrate.project import read_posterior

    path = tmp_path / "cohort.json"
    path.write_text(
        json.dumps(
            {
                "median": {"mu": 75.0, "lam": 70.0},
                "log_sd": {"mu": 0.1, "lam": 0.15},
                "correlation": {"mu,lam": 0.6},
            }
        )
    )
    words = ["infer", "once_clamped_beam", "--truth", "mu=73", "lam=61", "--prior", str(path)]
    words += ["--sampler", "laplace", "--no-certify"]
    main([*words, "--out", str(tmp_path / "kept")])
    path.unlink()  # a kept run does not need the file
    _, posterior = read_posterior(tmp_path / "kept")
    assert posterior.model.dependence.correlation[0, 1] == 0.6
