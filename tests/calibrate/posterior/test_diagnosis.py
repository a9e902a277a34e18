"""What is wrong with a run, in words."""

import numpy as np
import pytest

from calibrate.posterior.diagnosis import diagnose

GOOD = {"mu": {"r_hat": 1.001, "ess_bulk": 900.0, "ess_tail": 800.0}}
DRAWS = {"mu": np.random.default_rng(0).normal(70.0, 2.0, size=(4, 500))}


def said(statistics=None, row=None, attributes=None):
    summary = {"mu": {**GOOD["mu"], **(row or {})}}
    return list(diagnose(DRAWS, statistics or {}, summary, attributes or {}))


def test_nothing_is_said_of_a_good_run():
    assert said({"diverging": np.zeros((4, 500), bool), "accepted": np.ones((4, 500))}) == []


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
        ({"statistics": {"accepted": np.eye(50)}}, "FEM took 2 % of the proposals only"),
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
