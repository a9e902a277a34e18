import arviz_stats
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

import calibrate as cal
from calibrate.importance import transport
from emulator.core.errors import InputError
from emulator.fem import run_campaign, sobol
from emulator.surrogates.corrected import corrected
from emulator.surrogates.fem import fem_forward
from emulator.surrogates.pod_gp import fit_reduced
from linear_support import bent_problem, linear_forward

PRIOR_MEAN, PRIOR_SD = np.array([70.0, 75.0]), np.array([5.0, 8.0])


@pytest.fixture(scope="module")
def problem(beam):
    forward = linear_forward(beam)
    observe = cal.nodal_displacements(beam, [3, 11, 20])
    prior = {
        name: dist.Normal(m, s)
        for name, m, s in zip(beam.parameter_names, PRIOR_MEAN, PRIOR_SD, strict=True)
    }
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.1), prior)
    noise = 0.1 * np.random.default_rng(0).normal(size=(3, 3))
    data = np.asarray(forward.at(observe.nodes)(jnp.array([72.0, 68.0]))) + noise
    return forward, observe, model, data


@pytest.mark.slow
def test_the_same_seed_gives_the_same_draws(problem):
    _, _, model, data = problem
    options = cal.samplers.NUTSOptions(100, 50, rounds=1)
    a, b, c = (cal.sample(model, data, options=options, seed=s).draws()["mu"] for s in (3, 3, 4))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


@pytest.mark.slow
def test_unknown_noise_is_inferred(beam):
    forward = linear_forward(beam)
    observe = cal.nodal_displacements(beam, "all")
    model = cal.model(forward, observe, cal.GaussianNoise(sd_scale=1.0))
    noise = 0.3 * np.random.default_rng(1).normal(size=(45, 3))
    data = np.asarray(forward(jnp.array([72.0, 68.0]))) + noise
    posterior = cal.sample(model, data, options=cal.samplers.NUTSOptions(300, 500))
    row = posterior.summary()["noise_sd"]
    assert row["r_hat"] < 1.01
    # 135 residuals fix a standard deviation to about 6 %.
    assert row["mean"] == pytest.approx(0.3, rel=0.2)
    assert row["sd"] == pytest.approx(0.3 / np.sqrt(2 * 135), rel=0.3)


@pytest.mark.slow
def test_no_draw_lies_where_the_forward_map_is_invalid(beam):
    from dataclasses import replace

    forward = replace(linear_forward(beam), limit=80.0)
    model = cal.model(forward, cal.nodal_displacements(beam, [3]), cal.GaussianNoise(sd=10.0))
    posterior = cal.sample(model, np.zeros((1, 3)), options=cal.samplers.NUTSOptions(200, 200))
    for values in posterior.draws().values():
        assert values.max() < 80.0


@pytest.mark.parametrize(
    "options", [{"draws": 0}, {"warmup": -1}, {"chains": 0}, {"target_accept": 1.0}]
)
def test_options_that_cannot_work(options):
    with pytest.raises(InputError, match=f"NUTS: {next(iter(options))} is"):
        cal.samplers.NUTSOptions(**options)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fem", "corrected"])
def test_fem_inside_the_sampler(beam, simulator, kind):
    """The forward maps that solve: under vmap and grad, inside NUTS."""
    theta = beam.theta(mu=73.0, lam=61.0)
    nodes = beam.mesh.node_set("right")
    forward = fem_forward(simulator)
    if kind == "corrected":
        runs = run_campaign(simulator, sobol(beam, 8, 0))
        forward = corrected(fit_reduced(beam, runs), simulator)
    model = cal.model(forward, cal.nodal_displacements(beam, nodes), cal.GaussianNoise(sd=0.05))
    data = np.asarray(simulator(theta)[nodes])
    data = data + 0.05 * np.random.default_rng(0).normal(size=data.shape)
    posterior = cal.sample(
        model, data, options=cal.samplers.NUTSOptions(15, 15, chains=2, rounds=1)
    )
    draws = posterior.draws()["mu"]
    assert np.isfinite(draws).all()
    assert abs(draws.mean() - 73.0) < 10.0  # too few draws for more than the right place


def test_a_shear_keeps_volumes_and_can_be_undone():
    rng = np.random.default_rng(0)
    for dimension in (2, 3, 5):
        start = transport.standard_identity(dimension).bend
        map_ = transport.TransportMap(
            jnp.asarray(rng.permutation(dimension)),
            jnp.asarray(rng.normal(size=start.coefficients.shape)),
        )
        zeta = jnp.asarray(rng.normal(size=dimension))
        np.testing.assert_array_equal(transport.apply(start, zeta), zeta)
        jacobian = jax.jacfwd(lambda x, m=map_: transport.apply(m, x))(zeta)
        assert np.linalg.det(jacobian) == pytest.approx(1.0, abs=1e-10)


def test_a_fitted_shear_straightens_a_bent_ridge():
    rng = np.random.default_rng(1)
    first = rng.logistic(size=2000)
    x = 1 / (1 + np.exp(-first))
    second = 2 * x - 3 * x**2 + 1e-3 * rng.normal(size=2000)
    map_ = transport.fit(np.column_stack([second, first]))
    np.testing.assert_array_equal(map_.order, [1, 0])
    # The residual of the fit, which is the second coordinate of zeta, is what is left of it.
    straight = jax.vmap(lambda z: transport.apply(map_, z))(
        jnp.asarray(np.column_stack([0 * x, first]))
    )
    residual = second - np.asarray(straight[:, 0])
    assert residual.std() == pytest.approx(1e-3, rel=0.2)


@pytest.mark.slow
def test_a_bent_posterior_is_sampled_well(beam):
    """mu known to a thousandth along a curve across the whole box of lam."""

    model, data = bent_problem(beam)
    posterior = cal.sample(model, data, sampler="nuts")
    table = posterior.summary()
    assert min(row["ess_bulk"] for row in table.values()) > 1000
    assert max(row["r_hat"] for row in table.values()) < 1.01
    # Given the curve, lam has (nearly) its log-uniform prior times a slowly varying factor.
    lam = posterior.draws()["lam"]
    assert lam.min() < 52.0
    assert lam.max() > 97.0
    assert (
        float(arviz_stats.bfmi(posterior.tree["sample_stats"].to_dataset())["energy"].min()) > 0.5
    )
