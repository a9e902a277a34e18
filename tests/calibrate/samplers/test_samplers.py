"""Every sampler of the registry against a closed form, and the rules that all of them share."""

import threading
from dataclasses import replace

import arviz_stats
import jax
import numpy as np
import pytest

import calibrate as cal
from calibrate.samplers import SAMPLERS, BlackJAXNUTSOptions, density, find_sampler, r_hat
from calibrate.samplers.density import density_of
from calibrate.samplers.nuts import NUTS, NUTSOptions
from calibrate.samplers.options import ChainOptions
from calibrate.samplers.run import Programs
from calibrate.samplers.stopping import converged
from emulator.core.errors import InputError
from emulator.surrogates.fem import fem_forward
from linear_support import PRIOR_MEAN, PRIOR_SD, LinearFEM, closed_form, linear_problem


@pytest.fixture(scope="module")
def problem(beam):
    return linear_problem(beam)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n == "blackjax_nuts" else n for n in SAMPLERS],
)
def test_a_linear_gaussian_posterior_is_the_known_one(name, problem, beam):
    model, data = problem
    # FEM in a second stage: a draw costs a solve, and is nearly independent of the one before.
    draws = 250 if find_sampler(name).solves_fem else 1000
    options = find_sampler(name).options.sized(warmup=400, draws=draws, chains=4)
    posterior = cal.sample(
        model, data, sampler=name, options=options, seed=1, simulator=LinearFEM(beam, model.full)
    )
    nodes = model.observe.nodes
    mean, covariance = closed_form(model.full, nodes, data, 0.1, PRIOR_MEAN, PRIOR_SD)
    draws, table = posterior.draws(), posterior.summary()
    for k, parameter in enumerate(beam.parameter_names):
        sd = np.sqrt(covariance[k, k])
        ess = table[parameter]["ess_bulk"]
        assert ess > 400
        assert table[parameter]["r_hat"] < 1.01
        # Four standard errors at the effective sample size.
        assert abs(draws[parameter].mean() - mean[k]) < 4 * sd / np.sqrt(ess)
        assert draws[parameter].std() == pytest.approx(sd, rel=4 / np.sqrt(2 * ess))
    exact = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    assert np.corrcoef(*draws.values())[0, 1] == pytest.approx(exact, abs=4 / np.sqrt(400))
    statistics = posterior.tree["sample_stats"]
    assert set(statistics.data_vars) == set(find_sampler(name).statistics)
    assert all(np.isfinite(np.asarray(values)).all() for values in statistics.data_vars.values())
    assert posterior.divergences == 0
    assert posterior.tree.attrs["sampler"] == name


def test_one_chain_stops_and_has_an_r_hat(problem):
    model, data = problem
    # 1500 draws of an easy posterior meet the default limits; without the rule, 8 rounds follow.
    posterior = cal.sample(model, data, options=cal.NUTSOptions(400, 1500, chains=1), seed=1)
    assert posterior.tree["posterior"].sizes["draw"] < 8 * 1500
    assert all(1.0 <= row["r_hat"] + 1e-2 < 1.03 for row in posterior.summary().values())


def test_r_hat_of_one_chain_sees_a_drift():
    rng = np.random.default_rng(0)
    still = rng.normal(size=(1, 2000))
    assert r_hat(still) < 1.01
    assert r_hat(still + np.linspace(0.0, 3.0, 2000)) > 1.1
    assert np.isnan(r_hat(still[:, :7]))


def test_r_hat_of_several_chains_is_arviz_s():
    values = np.random.default_rng(1).normal(size=(4, 200))
    values[0] += 1.0
    assert r_hat(values) == pytest.approx(float(arviz_stats.rhat(values)))


def test_the_stopping_rule_asks_for_agreement_and_for_enough_draws():
    z = np.random.default_rng(2).normal(size=(4, 500, 2))
    assert converged(z, 1.01, 400.0)
    assert not converged(z, 1.01, 5000.0)
    z[0, :, 1] += 1.0
    assert not converged(z, 1.01, 400.0)


def test_an_unknown_sampler_and_options_of_another_are_refused(problem):
    model, data = problem
    with pytest.raises(InputError, match="sampler 'hmc' is unknown; known: nuts, blackjax_nuts"):
        cal.sample(model, data, sampler="hmc")
    with pytest.raises(InputError, match="'nuts' takes NUTSOptions, not BlackJAXNUTSOptions"):
        cal.sample(model, data, options=BlackJAXNUTSOptions())


@pytest.mark.parametrize("bad", [{"rounds": 0}, {"r_hat": 1.0}, {"ess": -1.0}])
def test_limits_that_cannot_work(bad):
    with pytest.raises(InputError, match=f"chains: {next(iter(bad))} is"):
        ChainOptions(**bad)


def test_chains_run_side_by_side_and_draw_what_they_draw_alone(beam):
    """Two chains meet inside the density: neither could go on without the other."""
    model, data = linear_problem(beam)
    posterior = density_of(model)
    together = threading.Barrier(2, timeout=60.0)

    def met(z, data):
        value = posterior.log_density(z, data)
        return value + jax.pure_callback(wait, jax.ShapeDtypeStruct((), float), value)

    def wait(value):
        together.wait()
        return np.zeros_like(value)

    def start(key, data, map_):
        z = jax.random.normal(key, (posterior.dimension,))
        return z, met(z, data)

    keys = jax.random.split(jax.random.key(0), 4)
    programs = Programs(start, lambda state, data, map_, count: (state, None), at_once=2)
    states, heights = programs.start(keys, data, None)
    for key, z, height in zip(keys, states, heights, strict=True):
        np.testing.assert_array_equal(z, jax.random.normal(key, (posterior.dimension,)))
        np.testing.assert_allclose(height, posterior.log_density(z, data), rtol=1e-12)

    def drawn(at_once):
        options = NUTSOptions(draws=40, warmup=40, rounds=1)
        return NUTS.sample(posterior._replace(at_once=at_once), data, options, seed=3)

    np.testing.assert_array_equal(drawn(3).z, drawn(1).z)


def test_as_many_chains_at_once_as_the_map_bears(beam, simulator, monkeypatch):
    monkeypatch.setattr(density, "cores", lambda: 8)
    monkeypatch.setattr(density, "at_once", lambda simulator: 3)
    model, _ = linear_problem(beam)
    assert density_of.__wrapped__(model).at_once == 8
    assert density_of.__wrapped__(replace(model, forward=fem_forward(simulator))).at_once == 3
