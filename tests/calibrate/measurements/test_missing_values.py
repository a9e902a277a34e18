"""Missing values are left out by name and counted, and the rest is conditioned on exactly."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import calibrate as cal
from calibrate.measurements import (
    leave_out_missing,
    observations,
    observations_from_json,
    spread_landmarks,
)
from calibrate.measurements.data import read_measurements, write_data
from calibrate.measurements.labels import missing_places
from calibrate.noise import CorrelatedNoise
from emulator.core.errors import InputError
from linear_support import linear_forward

THETA = jnp.array([70.0, 60.0])


@pytest.fixture
def model(beam):
    noise = cal.GaussianNoise(sd=0.3)
    observe = cal.nodal_displacements(beam, [7, 30, 12, 20])
    return cal.model(linear_forward(beam, size=0.1), observe, noise)


def predicted(model):
    return model.observe(model.forward(THETA)[None], THETA[None])["displacement"]


WITHOUT = ["of node 30 at (0, 0, 10) mm", "of node 12 at (50, 10, 0) mm"]


@pytest.fixture
def data(model):
    """Of four nodes, without one component of the second and all of the third."""
    exact = np.array(predicted(model))
    noisy = exact + np.random.default_rng(0).normal(0.0, 0.3, exact.shape)
    noisy[1, 2] = noisy[2] = np.nan
    return noisy


def predicted_there(model):
    return model.observe(model.forward(THETA)[None], THETA[None])


def test_the_density_is_that_of_the_values_that_are_there(model, data):
    reduced, kept = model.given(data)
    assert kept["displacement"].shape == (8,)
    mean = np.asarray(predicted(model))
    there = ~np.isnan(data)
    z = (data - mean)[there] / 0.3
    by_hand = np.sum(-0.5 * z**2) - 8 * np.log(0.3 * np.sqrt(2.0 * np.pi))
    found = reduced.log_density({}, predicted_there(reduced), kept)
    assert float(found) == pytest.approx(by_hand, rel=1e-12)
    assert missing_places(reduced.observe) == {"displacement": WITHOUT}


def test_correlated_noise_loses_the_rows_and_columns_of_what_is_missing(model, data):
    """Against SciPy's marginal of the whole covariance, which is made by loops."""
    noise = CorrelatedNoise(30.0, sd=0.2, spatial_sd=0.7)
    whole = cal.model(model.full, model.observe, noise)
    reduced, kept = whole.given(data)
    X = model.observe.parts["displacement"].points
    s = np.sqrt(3.0) * np.linalg.norm(X[:, None] - X, axis=-1) / 30.0
    C = np.kron(0.49 * (1.0 + s) * np.exp(-s), np.eye(3)) + 0.04 * np.eye(12)
    there = ~np.isnan(data).ravel()
    mean = np.asarray(predicted(model)).ravel()[there]
    expected = stats.multivariate_normal.logpdf(data.ravel()[there], mean, C[there][:, there])
    found = reduced.log_density({}, predicted_there(reduced), kept)
    assert float(found) == pytest.approx(expected, rel=1e-10)
    complete = data.copy()
    complete[np.isnan(data)] = np.asarray(predicted(model))[np.isnan(data)]
    _, all_there = whole.given(complete)
    filled = whole.log_density({}, predicted_there(whole), all_there)
    assert abs(float(filled) - expected) > 0.5  # filling the gaps would say something else


def test_gaps_of_one_load_state(ventricle):
    points = spread_landmarks(ventricle, 3, seed=0)
    part = cal.landmarks(ventricle, points)
    names = ("displacement@low", "displacement@high")
    forward = linear_forward(ventricle, size=1.0)
    model = cal.model(forward, dict.fromkeys(names, part), cal.GaussianNoise(sd_scale=1.0))
    draw = {name: jnp.asarray(0.5) for name in model.states.unknowns}
    data = {name: np.array(value) for name, value in model.predict(draw)[0].items()}
    data["displacement@high"][0, 1] = np.nan
    reduced, kept = model.given(data)
    assert {name: values.shape for name, values in kept.items()} == dict(
        zip(names, ((3, 3), (8,)), strict=True)
    )
    assert missing_places(reduced.observe) == {"displacement@high": part.row_names[:1]}
    assert reduced.names == model.names
    thetas = reduced.states.thetas(draw)
    means = reduced.observe(reduced.evaluate(thetas).displacement, thetas)
    found = reduced.log_density({**draw, "noise_sd": jnp.asarray(0.5)}, means, kept)
    assert float(found) == pytest.approx(-17 * np.log(0.5 * np.sqrt(2.0 * np.pi)))


def test_complete_data_leave_the_model_as_it_is(model, data):
    complete = np.nan_to_num(data)
    same, kept = model.given(complete)
    assert same is model
    np.testing.assert_array_equal(kept["displacement"], complete)
    with pytest.raises(InputError, match="4 of 12 values of displacement are missing"):
        model.check_data(data)
    with pytest.raises(InputError, match="every value of displacement is missing"):
        model.given(np.full((4, 3), np.nan))


def test_batches_sites_and_json(beam, model, data):
    observe, kept = leave_out_missing(model.observe, {"displacement": data})
    (part,), entries = observe.parts.values(), observe.entries["displacement"]
    u = jnp.asarray(np.random.default_rng(1).normal(size=(2, 5, 4, 3)))
    there = ~np.isnan(data)
    nowhere = jnp.zeros((2, 5, 1, 2))
    seen = observe(u[:, :, None], nowhere)["displacement"]
    np.testing.assert_array_equal(seen, np.asarray(u)[:, :, there])
    rows, component = np.nonzero(there)
    sites = observe.sites("displacement")
    np.testing.assert_array_equal(sites.positions, part.points[rows])
    np.testing.assert_array_equal(sites.component, component)
    again = observations_from_json(beam, json.loads(json.dumps(observe.to_json())))
    np.testing.assert_array_equal(again.entries["displacement"], entries)
    # Values that go missing later are left out of those that are there.
    fewer, _ = leave_out_missing(
        observe, {"displacement": np.where(np.arange(8), kept["displacement"], np.nan)}
    )
    assert fewer.parts["displacement"].shape == (4, 3)
    assert fewer.shapes == {"displacement": (7,)}
    np.testing.assert_array_equal(fewer.entries["displacement"], entries[1:])
    assert missing_places(fewer) == {"displacement": ["of node 7 at (50, 5, 0) mm", *WITHOUT]}


@pytest.mark.slow
def test_the_posterior_says_what_is_missing(model, data):
    from calibrate.samplers import NUTSOptions

    options = NUTSOptions(warmup=50, draws=50, chains=1, rounds=1)
    posterior = cal.sample(model, data, options=options)
    tree = posterior.tree
    assert json.loads(tree.attrs["missing"]) == {"displacement": WITHOUT}
    names = json.loads(tree.attrs["data"])["displacement"]
    assert len(names) == 8
    assert names[-1].startswith("displacement z of node ")
    observed = tree["observed_data"]["displacement"]
    np.testing.assert_array_equal(observed, data[~np.isnan(data)])
    assert observed.dims == ("entry_displacement",)
    np.testing.assert_array_equal(observed["entry_displacement"], [0, 1, 2, 3, 4, 9, 10, 11])
    assert tree["constant_data"]["position"].shape == (4, 3)


def test_files_keep_gaps(ventricle, tmp_path):
    points = spread_landmarks(ventricle, 3, seed=0)
    several = observations(
        {"displacement": cal.landmarks(ventricle, points), "volume": cal.CavityVolume(ventricle)}
    )
    data = {"displacement": np.arange(9.0).reshape(3, 3), "volume": 120.0}
    data["displacement"][0] = data["displacement"][2, 1] = np.nan
    for file in ("d.csv", "d.nc"):
        write_data(tmp_path / file, several, data)
        back, values = read_measurements(ventricle, tmp_path / file)[:2]
        np.testing.assert_array_equal(values["displacement"], data["displacement"])
        np.testing.assert_allclose(back.parts["displacement"].points, points)
    assert "NA" in (tmp_path / "d.csv").read_text()
    # A file can be written from what is left, too.
    reduced, kept = leave_out_missing(several, {k: np.asarray(v) for k, v in data.items()})
    write_data(tmp_path / "e.csv", reduced, kept)
    assert (tmp_path / "e.csv").read_text() == (tmp_path / "d.csv").read_text()


@pytest.mark.parametrize("gap", ["", "NA", "nan", "n/a"])
def test_gaps_in_csv(beam, tmp_path, gap):
    (tmp_path / "d.csv").write_text(
        f"node,ux,uy,uz,remark\n7,0.5,{gap},3,\n30,1,2,1e-7,lost\n9,,,,\n"
    )
    observe, data = read_measurements(beam, tmp_path / "d.csv")[:2]
    np.testing.assert_array_equal(observe.parts["displacement"].nodes, [7, 30, 9])
    np.testing.assert_array_equal(
        data["displacement"], [[0.5, np.nan, 3.0], [1.0, 2.0, 1e-7], [np.nan] * 3]
    )
