"""The DataTree on disk: its groups, units, and that ArviZ works on it as it is."""

import arviz as az
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from numpyro import distributions as dist

import calibrate as cal
from calibrate.noise import CorrelatedNoise
from calibrate.posterior import predictions
from calibrate.samplers import SMCOptions
from linear_support import linear_forward, linear_problem

GROUPS = {
    "posterior",
    "sample_stats",
    "prior",
    "prior_predictive",
    "posterior_predictive",
    "log_likelihood",
    "observed_data",
    "constant_data",
}


@pytest.fixture(scope="module")
def posterior(beam):
    model, data = linear_problem(beam)
    return cal.sample(model, data, options=cal.samplers.NUTSOptions(200, 300, chains=2, rounds=1))


@pytest.fixture(scope="module")
def particles(posterior):
    model, data = posterior.model, posterior.data
    return cal.sample(model, data, sampler="smc", options=SMCOptions(draws=300, chains=2))


@pytest.fixture(
    scope="module", params=["posterior", pytest.param("particles", marks=pytest.mark.slow)]
)
def saved(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "posterior.nc"
    request.getfixturevalue(request.param).save(path)
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        return tree.load()


def test_groups_and_units_survive_on_disk(saved):
    assert set(saved.children) == GROUPS
    units = {
        (group, name): variable.attrs["units"]
        for group in GROUPS - {"sample_stats", "log_likelihood"}
        for name, variable in saved[group].data_vars.items()
    }
    assert units["posterior", "mu"] == units["prior", "lam"] == "kPa"
    assert units["observed_data", "displacement"] == "mm"
    assert units["constant_data", "position"] == "mm"
    assert saved["log_likelihood"]["displacement"].sizes["draw"] == 300
    for group in ("posterior_predictive", "prior_predictive"):
        assert saved[group]["displacement"].dims == ("chain", "draw", "point", "component")


@pytest.mark.parametrize(
    "function",
    [
        az.summary,
        az.plot_trace_dist,
        az.plot_rank,
        az.plot_ppc_dist,
        az.loo,
        lambda tree: az.plot_ppc_dist(tree, group="prior_predictive"),
        lambda tree: az.plot_prior_posterior(tree),
    ],
)
@pytest.mark.filterwarnings("ignore")  # ArviZ's own, of what it will rename
def test_arviz_takes_the_saved_file_as_it_is(function, saved):
    mpl.use("Agg")
    found = function(saved)
    if function is az.loo:
        assert found.n_data_points == 9
        assert np.isfinite(found.elpd)
        assert float(np.max(found.pareto_k)) < 0.7


def test_log_likelihoods_are_the_formula_s(posterior):
    model, tree = posterior.model, posterior.tree
    thetas = np.asarray(posterior.thetas()).reshape(2, 300, 2)
    mean = np.asarray(model.forward(jnp.asarray(thetas[1, 7])))
    z = (np.asarray(posterior.data["displacement"]) - mean) / 0.1
    expected = -0.5 * z**2 - np.log(0.1) - 0.5 * np.log(2.0 * np.pi)
    found = tree["log_likelihood"]["displacement"].values[1, 7]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_replicated_data_has_the_model_s_mean_and_noise(posterior):
    tree = posterior.tree
    replicated = tree["posterior_predictive"]["displacement"]
    assert replicated.sizes["chain"] * replicated.sizes["draw"] == 500
    rows = replicated["draw"].values
    assert rows[0] == 0
    assert rows[-1] == 299
    thetas = np.asarray(posterior.thetas()).reshape(2, 300, 2)[:, rows].reshape(-1, 2)
    means = np.array([posterior.model.forward(jnp.asarray(theta)) for theta in thetas])
    noise = replicated.values.reshape(means.shape) - means
    assert noise.std() == pytest.approx(0.1, rel=4 / np.sqrt(2 * noise.size))
    assert abs(noise.mean()) < 4 * 0.1 / np.sqrt(noise.size)


@pytest.mark.slow
def test_the_prior_is_the_prior_where_the_map_answers(beam):
    from dataclasses import replace

    forward = replace(linear_forward(beam), limit=75.0)
    observe, noise = cal.nodal_displacements(beam, [3]), cal.GaussianNoise(sd=10.0)
    prior = {name: dist.Uniform(60.0, 80.0) for name in beam.parameter_names}
    model = cal.model(forward, observe, noise, prior)
    posterior = cal.sample(
        model, np.zeros((1, 3)), options=cal.samplers.NUTSOptions(50, 50, chains=1, rounds=1)
    )
    drawn = posterior.tree["prior"]["mu"].values
    assert 60.0 < drawn.min() < 61.0
    assert 74.0 < drawn.max() < 75.0


def test_predictions_can_be_left_out(beam):
    model, data = linear_problem(beam)
    options = cal.samplers.NUTSOptions(50, 50, chains=1, rounds=1)
    tree = cal.sample(model, data, options=options, predictions=False).tree
    assert set(tree.children) == {"posterior", "sample_stats", "observed_data", "constant_data"}


def test_dependent_data_have_one_log_likelihood_a_draw():
    normal = dist.MultivariateNormal(jnp.zeros(3), jnp.eye(3))
    assert predictions._pointwise(normal, jnp.ones(3)).shape == ()
    independent = dist.Normal(jnp.zeros(3), 1.0).to_event(1)
    assert predictions._pointwise(independent, jnp.ones(3)).shape == (3,)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto")
def test_correlated_noise_and_missing_values_have_their_groups(beam):
    forward = linear_forward(beam)
    observe = cal.nodal_displacements(beam, [3, 11, 20])
    noise = CorrelatedNoise(length=20.0, sd=0.1, spatial_sd_scale=0.1)
    model = cal.model(forward, observe, noise)
    data = np.array(forward.at(observe.nodes)(jnp.array([72.0, 68.0])))
    data[1, 2] = np.nan
    options = cal.samplers.NUTSOptions(100, 500, chains=1, rounds=1)
    tree = cal.sample(model, data, options=options).tree
    assert tree["log_likelihood"]["displacement"].sizes["entry_displacement"] == 8
    assert az.loo(tree).n_data_points == 8
    assert tree["posterior"]["spatial_sd"].attrs["units"] == "mm"
    for group in set(tree.children):
        for name, values in tree[group].data_vars.items():
            if group != "constant_data" and values.dtype.kind == "f":
                assert np.isfinite(values.values).all(), (group, name)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_single_number_is_plotted_too(ventricle):
    mpl.use("Agg")
    forward = linear_forward(ventricle, size=1.0)
    noise = cal.GaussianNoise(sd=4.0)
    model = cal.model(forward, cal.CavityVolume(ventricle), noise, check_scale=False)
    options = cal.samplers.NUTSOptions(50, 60, chains=1, rounds=1)
    tree = cal.sample(model, {"volume": 120.0}, options=options).tree
    assert tree["observed_data"]["volume"].dims == ("volume_number",)
    assert tree["log_likelihood"]["volume"].dims == ("chain", "draw", "volume_number")
    az.plot_ppc_dist(tree)
    assert np.isfinite(az.loo(tree).elpd)
