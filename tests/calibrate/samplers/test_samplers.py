"""Every sampler of the registry against a closed form, and the rules that all of them share."""

from dataclasses import replace

import numpy as np
import pytest

import calibrate as cal
from calibrate.samplers import (
    SAMPLERS,
    BlackJAXNUTSOptions,
    ChainOptions,
    find_sampler,
    options_from,
)
from calibrate.statistical_model import density
from calibrate.statistical_model.density import density_of
from emulator.core.errors import InputError
from emulator.surrogates.fem import fem_forward
from linear_support import PRIOR_MEAN, PRIOR_SD, closed_form, linear_problem

LONG = ("blackjax_nuts",)


@pytest.fixture(scope="module")
def problem(beam):
    return linear_problem(beam)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in SAMPLERS],
)
def test_a_linear_gaussian_posterior_is_the_known_one(name, problem, beam):
    model, data = problem
    options = options_from(find_sampler(name), {}, warmup=400, draws=1000, chains=4)
    posterior = cal.sample(model, data, sampler=name, options=options, seed=1)
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
    assert "lp" in statistics.data_vars
    assert all(np.isfinite(np.asarray(values)).all() for values in statistics.data_vars.values())
    assert posterior.divergences == 0
    assert posterior.tree.attrs["sampler"] == name


def test_one_chain_stops_and_has_an_r_hat(problem):
    model, data = problem
    # 1500 draws of an easy posterior meet the default limits; without the rule, 8 rounds follow.
    posterior = cal.sample(
        model, data, options=cal.samplers.NUTSOptions(400, 1500, chains=1), seed=1
    )
    assert posterior.tree["posterior"].sizes["draw"] < 8 * 1500
    assert all(1.0 <= row["r_hat"] + 1e-2 < 1.03 for row in posterior.summary().values())


def test_an_unknown_sampler_and_options_of_another_are_refused(problem):
    model, data = problem
    with pytest.raises(InputError, match="sampler 'hmc' is unknown; known: auto, importance, nuts"):
        cal.sample(model, data, sampler="hmc")
    with pytest.raises(InputError, match="'nuts' takes NUTSOptions, not BlackJAXNUTSOptions"):
        cal.sample(model, data, sampler="nuts", options=BlackJAXNUTSOptions())


@pytest.mark.parametrize("bad", [{"rounds": 0}, {"r_hat": 1.0}, {"ess": -1.0}])
def test_limits_that_cannot_work(bad):
    with pytest.raises(InputError, match=f"chains: {next(iter(bad))} is"):
        ChainOptions(**bad)


def test_as_many_chains_at_once_as_the_map_bears(beam, simulator, monkeypatch):
    monkeypatch.setattr(density, "cores", lambda: 8)
    monkeypatch.setattr(density, "at_once", lambda simulator: 3)
    model, _ = linear_problem(beam)
    assert density_of.__wrapped__(model).at_once == 8
    assert density_of.__wrapped__(replace(model, forward=fem_forward(simulator))).at_once == 3


def test_options_by_name():
    nuts, length = find_sampler("nuts"), {"warmup": 5, "draws": 6, "chains": 7}
    options = options_from(nuts, {"target_accept": 0.95, "rounds": 2}, **length)
    assert options == cal.samplers.NUTSOptions(5, 6, 7, target_accept=0.95, rounds=2)
    with pytest.raises(InputError, match="'nuts': unknown key 'leapfrogs'; known: chains, draws"):
        options_from(nuts, {"leapfrogs": 3}, **length)
    with pytest.raises(InputError, match="'nuts': rounds = \"two\"; expected a whole number"):
        options_from(nuts, {"rounds": "two"}, **length)
    with pytest.raises(InputError, match="'nuts': target_accept = true; expected a number"):
        options_from(nuts, {"target_accept": True}, **length)
    with pytest.raises(InputError, match="NUTS: rounds is 0; it must be 1 or more"):
        options_from(nuts, {"rounds": 0}, **length)
    assert options_from(nuts, {"ess": 50}, **length).ess == 50
