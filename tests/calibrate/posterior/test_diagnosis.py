"""What is wrong with a run, in words."""

import json

import numpy as np
import pytest
import xarray as xr

from calibrate.posterior.diagnosis import (
    MAP_ERRORS,
    MAP_MOVES,
    SCALED_NOISE,
    diagnose,
    nothing_learned,
)

GOOD = {"mu": {"r_hat": 1.001, "ess_bulk": 900.0, "ess_tail": 800.0}}
DRAWS = {"mu": np.random.default_rng(0).normal(70.0, 2.0, size=(4, 500))}


def said(statistics=None, row=None, attributes=None):
    summary = {"mu": {**GOOD["mu"], **(row or {})}}
    return list(diagnose(DRAWS, statistics or {}, summary, attributes or {}))


def test_nothing_is_said_of_a_good_run():
    assert said({"diverging": np.zeros((4, 500), bool)}) == []


def test_divergences_are_placed():
    (sentence,) = said({"diverging": DRAWS["mu"] < 67.0})
    count = int((DRAWS["mu"] < 67.0).sum())
    assert sentence.startswith(f"{count} divergent transitions of 2000")
    assert "mostly at low mu (6" in sentence
    assert "Raise target_accept" in sentence
    (sentence,) = said({"diverging": DRAWS["mu"] > 73.0})
    assert "mostly at high mu (73" in sentence
    everywhere = np.zeros((4, 500), bool)
    everywhere[:, ::10] = True
    (sentence,) = said({"diverging": everywhere})
    assert "spread over the whole posterior" in sentence


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"row": {"r_hat": 1.2}}, "the chains disagree about mu, R-hat 1.200"),
        ({"row": {"r_hat": np.nan}}, "R-hat of mu is not a number"),
        ({"row": {"ess_tail": 90.0}}, "90 effective draws of mu, fewer than 400"),
        (
            {"attributes": {"pareto_k": 0.9, "importance_efficiency": 0.8}},
            "the Gaussian approximation is poor, Pareto k 0.90",
        ),
        (
            {"attributes": {"pareto_k": 0.1, "importance_efficiency": 0.05}},
            "the Gaussian approximation is poor, Pareto k 0.10 (at most 0.7) and 5 % of",
        ),
    ],
)
def test_each_fault_has_its_sentence(change, message):
    (sentence,) = said(**change)
    assert sentence.startswith(message)


def test_divergences_of_many_parameters_are_placed_by_three():
    draws = {f"x{k}": DRAWS["mu"] + 0.1 * k for k in range(6)}
    summary = dict.fromkeys(draws, GOOD["mu"])
    (sentence,) = diagnose(draws, {"diverging": DRAWS["mu"] < 67.0}, summary, {})
    assert sentence.count("low x") == 3


def test_a_wrong_map_comes_first_and_chains_on_it_are_not_blamed_on_the_sampler():
    errors = {MAP_ERRORS: json.dumps({"reaction:top:x@a": 0.2, "reaction:top:x@b": 3.6})}
    first, chains, few = said(row={"r_hat": 1.5, "ess_bulk": 7.0}, attributes=errors)
    assert first.startswith("the forward map misses FEM by 3.6 noise sd in reaction:top:x@b")
    assert "infer with --forward rounds (FEM where the posterior is) or corrected" in first
    assert chains == "the chains disagree about mu, R-hat 1.500: mend the map first"
    assert "more draws" not in few
    # A specimen's maps are exact, so there is nothing to correct but the law's finite kappa; rounds
    # have no other map to begin from.
    for kind, remedy in (("incompressible", "infer with --forward homogeneous"),
                         ("homogeneous", "at the draws: check the options of FEM"),
                         ("rounds", "infer with more runs (--most-runs N)")):  # fmt: skip
        (sentence,) = said(attributes=errors | {"forward": kind})
        assert remedy in sentence
        assert "corrected" not in sentence
    small = {MAP_ERRORS: json.dumps({"volume": 0.4})}
    assert said(attributes=small) == []
    assert said(attributes=small | {MAP_MOVES: 0.4}) == []
    (moved,) = said(attributes=small | {MAP_MOVES: 0.6})
    assert moved.startswith(
        "the forward map misses FEM by 0.4 noise sd in volume at the draws, and FEM in its place would move a mean "
        "by 0.6 sd"
    )
    assert said(attributes={SCALED_NOISE: json.dumps(["volume has"])}) == ["volume has"]


def tree(before, after):
    """A posterior's tree with two unknowns; ``before`` and ``after`` are (2, s)."""
    groups = {
        group: xr.Dataset(
            {n: (("chain", "draw"), row[None]) for n, row in zip("ab", rows, strict=True)}
        )
        for group, rows in (("prior", before), ("posterior", after))
    }
    return xr.DataTree.from_dict(groups)


def test_a_posterior_that_is_the_prior_is_said_to_be_that():
    rng = np.random.default_rng(0)
    before, after = rng.uniform(size=(2, 500)), rng.uniform(size=(2, 900))
    (line,) = nothing_learned(tree(before, after), ("a", "b"), "sd 1 mL of volume")
    assert line.startswith("the data say next to nothing: what is known best keeps ")
    assert "sd 1 mL of volume: give your data's if it is smaller (--noise)" in line
    # Known are: their sum only, one of them, that the ends are right and the middle is not.
    for known in (
        after[:, np.abs(after.sum(axis=0) - 1.0) < 0.2],
        after[:, after[1] < 0.4],
        after[:, np.abs(after[0] - 0.5) > 0.35],
    ):
        assert nothing_learned(tree(before, known), ("a", "b"), "") == []
    assert nothing_learned(tree(before[:, :9], after), ("a", "b"), "") == []
