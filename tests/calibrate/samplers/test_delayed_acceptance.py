"""Delayed acceptance draws from FEM's posterior, whatever the cheap map says."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import calibrate as cal
from calibrate.samplers import DelayedAcceptanceOptions, density_of
from calibrate.samplers.delayed_acceptance import _choose, _Position
from calibrate.samplers.density import tempered
from calibrate.samplers.protocol import TunedState
from emulator.core.errors import InputError, SolverError
from linear_support import (
    PRIOR_MEAN,
    PRIOR_SD,
    LinearFEM,
    closed_form,
    linear_forward,
    linear_problem,
)

OPTIONS = DelayedAcceptanceOptions(warmup=200, draws=400, rounds=1)


@pytest.fixture(scope="module")
def biased(beam):
    """A cheap map that is off by 0.03 mm, a third of the noise sd, and 2 % too stiff."""
    exact = linear_forward(beam)
    cheap = replace(exact, matrix=0.98 * exact.matrix, shift=exact.shift + 0.03)
    return exact, *linear_problem(beam, cheap)


def sds_off(posterior, exact, data):
    """Errors of the means in posterior sd, ratio of sds, and effective draws, by parameter."""
    nodes = posterior.model.observe.nodes
    mean, covariance = closed_form(exact, nodes, data, 0.1, PRIOR_MEAN, PRIOR_SD)
    sd = np.sqrt(np.diag(covariance))
    draws = np.array(list(posterior.draws().values()))
    ess = np.array([row["ess_bulk"] for row in posterior.summary().values()])
    return (draws.mean(axis=1) - mean) / sd, draws.std(axis=1) / sd, ess


@pytest.mark.slow  # test_samplers has the map that is not biased
def test_a_biased_cheap_map_leaves_fem_s_posterior_exact(beam, biased):
    exact, model, data = biased
    posterior = cal.sample(
        model,
        data,
        sampler="delayed_acceptance",
        options=OPTIONS,
        seed=2,
        simulator=LinearFEM(beam, exact),
    )
    shift, ratio, ess = sds_off(posterior, exact, data)
    assert ess.min() > 100
    assert (abs(shift) < 4 / np.sqrt(ess)).all()
    np.testing.assert_allclose(ratio, 1.0, atol=(4 / np.sqrt(2 * ess)).max())
    with pytest.raises(InputError, match="is FEM's already; it needs no certificate"):
        cal.certify(posterior, LinearFEM(beam, exact))
    # The cheap posterior is another one.
    cheap = cal.sample(model, data, options=cal.NUTSOptions(200, 400, rounds=1))
    assert abs(sds_off(cheap, exact, data)[0]).max() > 2 * (4 / np.sqrt(ess)).max()


@pytest.mark.slow
def test_statistics_count_fem_solves_and_acceptance(beam, biased):
    exact, model, data = biased
    solved = []

    class Counted(LinearFEM):
        def solve(self, theta, start=None):
            solved.append(np.asarray(theta))
            return super().solve(theta, start)

    options = replace(OPTIONS, draws=50, power=1.0)
    call = {"sampler": "delayed_acceptance", "options": options, "seed": 1}
    posterior = cal.sample(model, data, simulator=Counted(beam, exact), **call)
    statistics = posterior.tree["sample_stats"]
    counted = int(statistics["fem_solves"].sum())
    # Those of the start and of the discarded draws come on top.
    assert counted <= 4 * 50 <= len(solved) <= 4 * (1 + 20 + 50)
    assert posterior.tree.attrs["fem_solves"] == len(solved)
    draws = posterior.tree["posterior"]["mu"].values
    moved = np.diff(draws, axis=1) != 0
    np.testing.assert_array_equal(statistics["accepted"].values[:, 1:], moved)
    # What it says of single data is FEM's, as its draws are.
    theta = np.stack([posterior.tree["posterior"][n].values for n in ("mu", "lam")], axis=-1)
    means = jax.vmap(jax.vmap(exact.at(model.observe.nodes)))(jnp.asarray(theta))
    told = posterior.tree["log_likelihood"]["displacement"].values
    np.testing.assert_allclose(told, norm.logpdf(data, means, 0.1), atol=1e-9)
    # A cheap map that is right is never turned down.
    right = cal.sample(model, data, simulator=LinearFEM(beam, model.full), **call)
    assert float(right.tree["sample_stats"]["acceptance_rate"].min()) == pytest.approx(1.0)
    assert 0.2 < float(statistics["acceptance_rate"].mean()) < 0.95
    assert float(right.tree["sample_stats"]["log_w"].max()) == pytest.approx(0.0, abs=1e-9)


def test_a_power_below_one_widens_proposals(beam, biased):
    _, model, data = biased
    density = density_of(model)
    checked, z = model.check_data(data), jnp.array([0.4, -0.3])
    wide = tempered(density, 0.5)
    expected = density.log_prior(z) + 0.5 * density.log_likelihood(z, checked)
    assert float(wide.log_density(z, checked)) == pytest.approx(float(expected))
    assert tempered(density, 1.0) is density
    assert tempered(density, 0.5) is wide  # or its programs would be compiled again
    with pytest.raises(InputError, match="delayed acceptance: power is 0.0; give one in"):
        DelayedAcceptanceOptions(power=0.0)


@pytest.mark.slow
def test_where_fem_fails_there_are_no_draws(beam, biased):
    exact, model, data = biased
    fem = LinearFEM(beam, exact, limit=72.0)
    options = replace(OPTIONS, draws=50)
    call = {"sampler": "delayed_acceptance", "options": options}
    posterior = cal.sample(model, data, simulator=fem, **call)
    assert max(values.max() for values in posterior.draws().values()) < 72.0
    with pytest.raises(SolverError, match="FEM converged at none of a chain's first 21 proposals"):
        cal.sample(model, data, simulator=replace(fem, limit=1.0), **call)


def test_a_rejected_chain_stays_with_a_fresh_key(beam):
    keys = jax.random.split(jax.random.key(0), 4)
    rng = np.random.default_rng(0)

    def position(keys, z):
        states = tuple(TunedState(key, x, x[0], x) for key, x in zip(keys, z, strict=True))
        return _Position(states, z, z[:, 0], z[:, 1], {"displacement": z})

    new, old = (
        position(keys[:2], rng.normal(size=(2, 3))),
        position(keys[2:], rng.normal(size=(2, 3))),
    )
    found = _choose(np.array([True, False]), new, old)
    np.testing.assert_array_equal(found.z, np.stack([new.z[0], old.z[1]]))
    np.testing.assert_array_equal([state.state for state in found.states], found.z)
    np.testing.assert_array_equal(found.means["displacement"], found.z)
    assert [state.rng_key for state in found.states] == list(keys[:2])


def test_the_cheap_sampler_is_given_what_a_user_asks_for():
    cheap = DelayedAcceptanceOptions(target_accept=0.93, start="pathfinder").cheap()
    assert (cheap.target_accept, cheap.start) == (0.93, "pathfinder")


def test_it_needs_a_simulator_of_the_posterior_s_scene(beam, cube):
    model, data = linear_problem(beam)
    with pytest.raises(InputError, match="'delayed_acceptance' solves FEM .* give simulator="):
        cal.sample(model, data, sampler="delayed_acceptance")
    with pytest.raises(InputError, match="the simulator's scene is not the posterior's"):
        cal.sample(model, data, sampler="delayed_acceptance", simulator=LinearFEM(cube, model.full))
    with pytest.raises(InputError, match="delayed acceptance: transitions is 0"):
        DelayedAcceptanceOptions(transitions=0)
