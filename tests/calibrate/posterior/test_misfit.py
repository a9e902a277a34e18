"""Data that could not have come from the model is told, other data is not."""

import json
import re

import numpy as np
import pytest
import xarray as xr
from scipy.stats import chi2

from calibrate.posterior.diagnosis import DATUM_NAMES, SMALLEST_P, misfit_of, misfits


def tree(data, sd=1.0, correlated=False):
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, sd, (4, 125, 1 if correlated else data.size))
    replicates = np.broadcast_to(noise, (4, 125, data.size)).reshape(4, 125, *data.shape)
    names = [f"d{k}" for k in range(data.ndim)]
    return xr.DataTree.from_dict(
        {
            "observed_data": xr.Dataset({"u": (names, data)}),
            "posterior_predictive": xr.Dataset({"u": (["chain", "draw", *names], replicates)}),
        }
    )


def test_data_of_the_model_is_not_told():
    """Of 200 data sets of the model itself, at most one in fifty."""
    rng = np.random.default_rng(1)
    told = [bool(misfits(tree(rng.normal(size=(20, 3))))) for _ in range(200)]
    assert sum(told) <= 4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda y: 1.6 * y, r"p 0\.000"),  # chi squared of 60 data 2.6 times too large
        (lambda y: y + np.where(np.arange(60).reshape(20, 3) == 7, 9.0, 0.0), r"number 8 of u is"),
        (lambda y: y + 500.0, r"(4|5)\d\d sd off"),
    ],
)
def test_what_is_wrong_is_told(change, said):
    y = np.random.default_rng(2).normal(size=(20, 3))
    assert not misfits(tree(y))
    (sentence,) = misfits(tree(change(y)))
    assert sentence.startswith("u does not fit the model")
    assert re.search(said, sentence)


def test_a_datum_is_named_as_the_posterior_names_it():
    y = np.random.default_rng(2).normal(size=(20, 3))
    y[2, 1] += 9.0
    names = [f"displacement {x} at ({k}, 0, 0) mm in state late" for k in range(20) for x in "xyz"]
    named = tree(y)
    named.attrs[DATUM_NAMES] = json.dumps({"u": names})
    assert "(displacement y at (2, 0, 0) mm in state late is " in misfits(named)[0]


def test_missing_data_are_left_out_and_one_number_has_no_place():
    y = np.random.default_rng(2).normal(size=(20, 3))
    y[3] = np.nan
    assert not misfits(tree(y))
    (sentence,) = misfits(tree(np.array([30.0])))
    assert "(number 1 of u is " in sentence


def test_errors_in_common_are_not_taken_for_many():
    """60 data 2.5 sd off together, where noise is common to all of them, is one error of 2.5 sd."""
    assert not misfits(tree(np.full((20, 3), 2.5), correlated=True))
    assert misfits(tree(np.full((20, 3), 2.5)))


def test_without_replicates_nothing_is_said():
    whole = tree(np.full((20, 3), 99.0))
    del whole["posterior_predictive"]
    assert misfits(whole) == []


def test_p_of_the_sum_is_chi_squareds():
    """Of independent Gaussian data, T_1 has the chi-squared distribution."""
    rng = np.random.default_rng(3)
    replicates, y = rng.normal(size=(4, 5000, 30)), rng.normal(size=30)
    for scale in (0.7, 1.0, 1.25):
        p = misfit_of(["u"] * 30, replicates, scale * y).p
        assert p == pytest.approx(chi2.sf(scale**2 * (y @ y), 30), abs=0.015)


def test_one_outlier_among_many_is_told_by_the_largest():
    """6 sd in one of 2000 data move the sum by 0.6 of its sd."""
    y = np.random.default_rng(4).normal(size=(2000, 1))
    y[1234] = 6.0
    replicates = tree(y)["posterior_predictive"]["u"].values
    found = misfit_of(["u"] * 2000, replicates, y)
    assert found.p > SMALLEST_P
    assert found.p_worst == 0.0
    assert "number 1235 of u is 6" in misfits(tree(y))[0]
