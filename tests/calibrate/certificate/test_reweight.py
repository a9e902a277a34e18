from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import calibrate as cal
from certificate_support import (
    NODES,
    exact_data,
    exact_posterior,
    grid_of,
    linear_model,
    quadrature,
)
from emulator.core.errors import InputError
from linear_support import LinearSimulator, linear_forward


@pytest.fixture(scope="module")
def biased(beam):
    """A posterior made with a map two noise sd off where mu moves it, FEM's map, and the data."""
    fem = linear_forward(beam, size=0.02)
    data = exact_data(linear_model(beam, forward=fem))
    off = 0.2 * np.sign(fem.matrix[..., 0])
    wrong = linear_model(beam, forward=replace(fem, shift=fem.shift + off))
    return exact_posterior(wrong, data), fem, data


def data_by(forward, posterior):
    """Data without noise by a map, at a posterior's draws."""
    draws = np.stack([posterior.tree["posterior"][name].values for name in ("mu", "lam")], axis=-1)
    at = jax.vmap(jax.vmap(forward.at(np.array(NODES))))
    return np.asarray(at(jnp.asarray(draws)))


@pytest.mark.slow
def test_the_reweighted_posterior_is_fems_and_is_accepted(biased):
    posterior, fem, data = biased
    reweighted = cal.reweight(posterior, LinearSimulator(fem))
    points, weights = grid_of(), quadrature(fem, data)
    moved = []
    for k, name in enumerate(("mu", "lam")):
        mean = weights @ points[:, k]
        sd = np.sqrt(weights @ (points[:, k] - mean) ** 2)
        row = reweighted.summary()[name]
        assert abs(row["mean"] - mean) < 0.2 * sd
        assert row["sd"] == pytest.approx(sd, rel=0.15)
        moved.append(abs(posterior.summary()[name]["mean"] - mean) / sd)
    assert max(moved) > 0.5
    assert reweighted.divergences == 0
    assert reweighted.data is posterior.data
    again = cal.certify(reweighted, LinearSimulator(fem))
    assert again.verdict in ("accepted", "undecided")


def test_it_leaves_the_posterior_alone(biased):
    posterior, fem, data = biased
    posterior.tree.attrs["log_evidence"] = 3.0
    before = {name: values.copy() for name, values in posterior.draws().items()}
    reweighted = cal.reweight(posterior, LinearSimulator(fem), draws=80)
    assert "reweighted" in reweighted.tree.attrs
    assert "reweighted" not in posterior.tree.attrs
    for name, values in posterior.draws().items():
        np.testing.assert_array_equal(values, before[name])
    assert posterior.tree.attrs.pop("log_evidence") == 3.0
    # What it says of single data, and of data that might be, is FEM's as its draws are.
    assert "log_evidence" not in reweighted.tree.attrs
    means = data_by(fem, reweighted)
    for_fem = norm.logpdf(data, means, 0.1)
    found = reweighted.tree["log_likelihood"]["displacement"].values
    np.testing.assert_allclose(found, for_fem, atol=0.02)
    by_map = norm.logpdf(data, data_by(posterior.model.full, reweighted), 0.1)
    assert np.abs(by_map - for_fem).max() > 1.0
    replicated = reweighted.tree["posterior_predictive"]["displacement"].values.mean(axis=(0, 1))
    np.testing.assert_allclose(replicated, means.mean(axis=(0, 1)), atol=0.03)


def test_it_is_refused_where_nothing_says_it_is_fems(biased):
    posterior, fem, _ = biased
    with pytest.raises(InputError, match="the verdict is 'not certified'"):
        cal.reweight(posterior, LinearSimulator(replace(fem, limit=0.0)), draws=25)
