"""Members of a population together: closed forms, missing members, new ones, bad input."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

import calibrate as cal
from calibrate.samplers import NUTSOptions
from emulator.core.errors import InputError
from emulator.scenes.parameter_space import Parameter
from linear_support import linear_forward

SHORT = NUTSOptions(warmup=300, draws=500, chains=4, rounds=4)
NODES = [3, 11, 20]


def model_of(scene, sd=0.05, forward=None, **more):
    forward = linear_forward(scene) if forward is None else forward
    observe = cal.nodal_displacements(scene, NODES)
    return cal.model(forward, observe, cal.GaussianNoise(sd=sd), check_scale=False, **more)


def data_of(model, theta, seed, sd=0.05):
    exact, _ = model.predict(dict(zip(model.states.unknowns, theta, strict=True)))
    noise = sd * np.random.default_rng(seed).normal(size=(3, 3))
    return np.asarray(exact["displacement"]) + noise


def members_of(model, noise, count=5):
    logs = np.log([70.0, 80.0]) + 0.12 * np.random.default_rng(5).normal(size=(count, 2))
    return {f"b{i}": (model, data_of(model, np.exp(x), i, noise)) for i, x in enumerate(logs)}


@pytest.fixture(scope="module")
def found(beam):
    """Five members, one without data, one with a missing value and an unknown noise sd."""
    model = model_of(beam, sd=0.2)
    members = members_of(model, noise=0.2)
    members["b1"] = (model, None)
    observe = cal.nodal_displacements(beam, NODES)
    gappy = cal.model(model.full, observe, cal.GaussianNoise(sd_scale=0.1), check_scale=False)
    members["b2"][1][1, 2] = np.nan
    members["b2"] = (gappy, members["b2"][1])
    return cal.population.hierarchy(members, options=SHORT, seed=3)


def close(values, mean, sd, ess):
    """Mean and sd within four standard errors of draws that count for ``ess``."""
    error = sd / np.sqrt(ess)
    assert abs(values.mean() - mean) < 4.0 * error
    assert abs(values.std() - sd) < 4.0 * error


@pytest.mark.slow
def test_the_mean_of_linear_gaussian_members_is_normal(beam):
    """m | y is normal: precision n / (s^2 + d^2) + 1 / 10^2, with the sd d of one member's data."""
    wide = (Parameter("mu", "kPa", 1.0, 160.0), Parameter("lam", "kPa", 1.0, 160.0))
    scene = replace(beam, parameters=wide)
    model = model_of(scene, known={"lam": 80.0}, prior={"mu": dist.Uniform(1.0, 160.0)})
    truth = 75.0 + 5.0 * np.random.default_rng(1).normal(size=3)
    members = {f"b{i}": (model, data_of(model, [t], i)) for i, t in enumerate(truth)}
    found = cal.population.hierarchy(
        members,
        median={"mu": dist.Normal(80.0, 10.0)},
        spread={"mu": dist.LogNormal(np.log(5.0), 1e-3)},
        options=SHORT,
    )
    forward = linear_forward(scene)
    column = forward.matrix[NODES, :, 0].ravel()
    shift = (forward.matrix[NODES, :, 1] * 80.0 + forward.shift[NODES]).ravel()
    estimates = [(y.ravel() - shift) @ column / (column @ column) for _, y in members.values()]
    variance = 5.0**2 + 0.05**2 / (column @ column)
    precision = 3 / variance + 1 / 10.0**2
    mean = (np.sum(estimates) / variance + 80.0 / 10.0**2) / precision
    row = found.summary()["median[mu]"]
    close(found.draws()["median[mu]"], mean, precision**-0.5, row["ess_bulk"])
    # A member: its own data, and the population without it.
    others = (precision - 1 / variance) ** -1
    ahead = (np.sum(estimates[1:]) / variance + 80.0 / 10.0**2) * others
    own = 0.05**2 / (column @ column)
    weights = np.array([1 / own, 1 / (others + 25.0)])
    first = found.member("b0")["mu"]
    exact = weights @ [estimates[0], ahead] / weights.sum()
    close(first, exact, weights.sum() ** -0.5, found.summary()["mu[b0]"]["ess_bulk"])


@pytest.mark.slow
def test_one_member_has_its_posterior_under_the_population(beam):
    """Of a known population, which as a prior is cal.priors.Population."""
    known = {"lam": 90.0}
    model = model_of(beam, known=known)
    data = data_of(model, [58.0], 7)
    found = cal.population.hierarchy(
        {"only": (model, data)},
        median={"mu": dist.LogNormal(np.log(60.0), 0.01)},
        spread={"mu": dist.LogNormal(np.log(0.1), 0.01)},
        options=SHORT,
    )
    prior = cal.priors.Population(median={"mu": 60.0}, log_sd={"mu": 0.1}).prior(beam)
    alone = cal.sample(
        model_of(beam, known=known, prior=prior), data, options=SHORT, predictions=False
    )
    draws, expected = found.member("only")["mu"], alone.draws()["mu"]
    ess = min(alone.summary()["mu"]["ess_bulk"], found.summary()["mu[only]"]["ess_bulk"])
    close(draws, expected.mean(), expected.std(), 0.5 * ess)


@pytest.mark.slow
def test_a_member_without_data_is_one_not_seen(found):
    together, new = found.member("b1"), found.new_member()
    for name in ("mu", "lam"):
        close(together[name], new[name].mean(), new[name].std(), 400.0)
        row = found.shrinkage()[name]["b1"]
        assert row.sd < row.alone_sd  # of the box
    (sentence,) = found.warnings()  # b4 was made with lam 97.3, beside the range's end
    assert sentence.startswith("the box ends the posterior, not the data: lam[b4] at 100 kPa")


@pytest.mark.slow
def test_members_shrink_towards_the_population(found):
    centre = np.log(found.summary()["median[mu]"]["mean"])
    rows = [row for member, row in found.shrinkage()["mu"].items() if member != "b1"]
    alone = np.array([np.log(row.alone_mean) for row in rows]) - centre
    together = np.array([np.log(row.mean) for row in rows]) - centre
    assert np.abs(together).mean() < 0.95 * np.abs(alone).mean()
    assert np.mean([row.sd for row in rows]) < 0.95 * np.mean([row.alone_sd for row in rows])


@pytest.mark.slow
def test_draws_have_names_and_units(found):
    draws = found.draws()
    assert {"median[mu]", "sd[lam]", "correlation[mu, lam]", "mu[b0]", "noise_sd[b2]"} < set(draws)
    assert set(found.member("b2")) == {"mu", "lam", "noise_sd"}
    assert set(found.member("b0")) == {"mu", "lam"}
    assert found.tree["posterior"]["mu"].attrs["units"] == "kPa"
    np.testing.assert_array_equal(
        found.tree["posterior"]["mu"].attrs["box"], [50.0, 100.0, 0.0, np.inf]
    )
    assert np.all(np.abs(draws["correlation[mu, lam]"]) < 1.0)
    assert np.all((draws["mu[b1]"] > 50.0) & (draws["mu[b1]"] < 100.0))
    assert "Population of 5 members" in repr(found)


@pytest.mark.slow
def test_a_member_that_wants_more_than_the_range_is_told(found):
    tree = found.tree.copy()
    mu = tree["posterior"]["mu"]
    draws = np.array(mu)
    draws[..., 0] = 100.0 - np.abs(np.random.default_rng(0).normal(size=mu.shape[:2]))
    tree["posterior"]["mu"] = mu.copy(data=draws)
    ends = {str(end) for end in replace(found, tree=tree).box_ends()}
    assert ends == {"mu[b0] at 100 kPa", "lam[b4] at 100 kPa"}


@pytest.mark.slow
def test_a_new_member_is_predicted_through_its_model(found, beam):
    model = model_of(beam, sd=0.05)
    data = found.predict(model, seed=1)["displacement"]
    exact = linear_forward(beam).at(np.array(NODES))
    new = found.new_member()
    means = np.asarray(jax.vmap(exact)(jnp.stack([new["mu"], new["lam"]], axis=1)))
    assert data.shape == (500, 3, 3)
    spread = np.sqrt(means.var(axis=0) + 0.05**2)
    np.testing.assert_allclose(data.mean(axis=0), means.mean(axis=0), atol=0.25 * spread.max())
    np.testing.assert_allclose(data.std(axis=0), spread, rtol=0.25)
    unknown = cal.model(
        model.full, model.observe, cal.GaussianNoise(sd_scale=0.1), check_scale=False
    )
    assert found.predict(unknown)["displacement"].shape == (500, 3, 3)


@pytest.mark.slow
def test_it_is_a_prior_of_the_next_member(found, beam):
    prior = found.as_prior()
    new = found.new_member()
    assert prior.median["mu"] == pytest.approx(np.exp(np.log(new["mu"]).mean()))
    assert prior.source == "a hierarchy of 5 members"
    assert "mu" in prior.prior(beam)


@pytest.mark.slow
def test_it_is_kept_in_a_file(found, tmp_path):
    found.save(tmp_path / "hierarchy.nc")
    again = cal.population.read_hierarchy(tmp_path / "hierarchy.nc")
    assert again.members == found.members
    assert again.summary() == found.summary()
    assert again.shrinkage() == found.shrinkage()


@pytest.mark.slow
def test_its_figure_has_a_panel_a_parameter(found, tmp_path):
    pytest.importorskip("matplotlib", reason="figures need matplotlib")
    from calibrate.figures import shrinkage

    shrinkage.draw(found, tmp_path / "members.png")
    assert (tmp_path / "members.png").read_bytes().startswith(b"\x89PNG")


def test_a_file_of_something_else_is_refused(tmp_path, beam):
    model = model_of(beam)
    options = NUTSOptions(warmup=20, draws=20, chains=1, rounds=1)
    data = data_of(model, [70.0, 80.0], 0)
    cal.sample(model, data, options=options, predictions=False).save(tmp_path / "posterior.nc")
    with pytest.raises(InputError, match="holds no hierarchy"):
        cal.population.read_hierarchy(tmp_path / "posterior.nc")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"shared": ("mu", "a_f")}, "member 'one' does not infer 'a_f'; it infers mu, lam"),
        ({"shared": ()}, "shared is (); give one or more names, each once"),
        ({"shared": "mu"}, "shared is 'mu'; give one or more names, each once"),
        ({"alone": "luck"}, "sampler 'luck' is unknown"),
        ({"options": 3}, "sampler 'nuts' takes NUTSOptions, not int"),
        ({"eta": 0.0}, "eta is 0.0; it must be above 0"),
        (
            {"shard": ("mu",)},
            "hierarchy: option 'shard' is unknown; known: options, alone, seed, progress, shared, "
            "median, spread, eta; did you mean 'shared'?",
        ),
        ({"spread": {"mu": -1.0}}, "spread of 'mu' is -1.0; give a number above 0"),
        ({"spread": {"kappa": 1.0}}, "spread of 'kappa'; shared: mu, lam"),
        ({"median": {"mu": dist.Uniform(1.0, 2.0)}}, "lies outside 50 to 100"),
    ],
)
def test_bad_words_are_refused(beam, more, words):
    model = model_of(beam)
    data = np.zeros((3, 3))
    with pytest.raises(InputError) as error:
        cal.population.hierarchy({"one": (model, data), "two": (model, data)}, **more)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_members_of_other_ranges_or_scales_are_refused(beam):
    model, data = model_of(beam), np.zeros((3, 3))
    for other in (
        Parameter("mu", "kPa", 50.0, 120.0, "log"),
        Parameter("mu", "kPa", 50.0, 100.0, "uniform"),
    ):
        second = model_of(replace(beam, parameters=(other, beam.parameters[1])))
        with pytest.raises(InputError, match="'mu' is 50 to 100 kPa .log. for 'one' and 50 to 1"):
            cal.population.hierarchy({"one": (model, data), "two": (second, data)})
    with pytest.raises(InputError, match="no members"):
        cal.population.hierarchy({})


def test_own_unknowns_that_depend_on_shared_ones_are_refused(beam):
    prior = cal.priors.Population(
        median={"mu": 70.0, "lam": 70.0},
        log_sd={"mu": 0.1, "lam": 0.1},
        correlation={"mu,lam": 0.5},
    ).prior(beam)
    model = model_of(beam, prior=prior)
    with pytest.raises(InputError, match="correlates mu, lam, of which only some follow"):
        cal.population.hierarchy({"one": (model, np.zeros((3, 3)))}, shared=("mu",))
