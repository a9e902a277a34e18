"""Data that could not have come from the model is told, other data is not."""

import re

import numpy as np
import pytest
import xarray as xr

from calibrate.fit import misfits


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
        (lambda y: y + np.where(np.arange(60).reshape(20, 3) == 7, 9.0, 0.0), r"u\[2, 1\] is"),
        (lambda y: y + 500.0, r"(4|5)\d\d sd off"),
    ],
)
def test_what_is_wrong_is_told(change, said):
    y = np.random.default_rng(2).normal(size=(20, 3))
    assert not misfits(tree(y))
    (sentence,) = misfits(tree(change(y)))
    assert sentence.startswith("u does not fit the model")
    assert re.search(said, sentence)


def test_missing_data_are_left_out_and_one_number_has_no_place():
    y = np.random.default_rng(2).normal(size=(20, 3))
    y[3] = np.nan
    assert not misfits(tree(y))
    (sentence,) = misfits(tree(np.array([30.0])))
    assert "(u is " in sentence


def test_errors_in_common_are_not_taken_for_many():
    """60 data 2.5 sd off together, where noise is common to all of them, is one error of 2.5 sd."""
    assert not misfits(tree(np.full((20, 3), 2.5), correlated=True))
    assert misfits(tree(np.full((20, 3), 2.5)))


def test_without_replicates_nothing_is_said():
    whole = tree(np.full((20, 3), 99.0))
    del whole["posterior_predictive"]
    assert misfits(whole) == []
