from dataclasses import replace

import numpy as np
import pytest

from calibrate.certificate.evidence import (
    NOBODY_SAID,
    SAID_HOMOGENEOUS,
    Changes,
    Evidence,
    Figure,
    MeshChange,
    Physics,
    Tail,
)
from calibrate.certificate.verdict import judge
from calibrate.posterior.diagnosis import Misfit, Sampling
from calibrate.posterior.taken_up import TakenUp


def changes(shift=0.0, error=0.01, log_sd=0.0, correlation=0.0):
    return Changes(
        {"x": Figure(shift, error)},
        {"x": Figure(log_sd, error)},
        {"x and y": Figure(correlation, error)},
    )


RIGHT = Evidence(
    draws=changes(),
    corrected=changes(),
    mean={"x": Figure(1.0, 0.01)},
    sd={"x": Figure(1.0, 0.01)},
    sampling=Sampling(1.001, 900.0, 800.0, 0, 4000),
    physics=Physics(200, 0, 0.0, 0.9, 0, 20),
    tail=Tail(0.1, 0.5, 90.0, 1.5, 0.1, 1000.0, missed=0),
    misfit={"displacement": Misfit(0.4, 0.5, {})},
)


def verdict(**entries):
    certificate = judge(replace(RIGHT, **entries))
    return certificate.verdict, " ".join(certificate.findings)


def sampling(**entries):
    return verdict(sampling=replace(RIGHT.sampling, **entries))


def test_what_is_right_is_accepted():
    assert judge(RIGHT).verdict == "accepted"
    assert judge(RIGHT).reason == "no mean moves by more than 0.00 posterior sd on this mesh"


@pytest.mark.parametrize("name", ["shift", "log_sd", "correlation"])
def test_each_figure_is_compared_with_its_limit(name):
    assert verdict(draws=changes(**{name: 0.1}))[0] == "accepted"
    assert verdict(draws=changes(**{name: -0.6}))[0] == "reweight"
    beyond = {"draws": changes(**{name: 0.6}), "corrected": changes(**{name: 0.6})}
    assert verdict(**beyond)[0] == "not certified"
    assert verdict(draws=changes(**{name: float("nan")}))[0] == "undecided"


def test_runs_that_only_fem_finds_likely_leave_it_undecided():
    found, words = verdict(tail=replace(RIGHT.tail, missed=2))
    assert found == "undecided"
    assert "2 FEM runs are likely where the corrected map says they are not" in words


@pytest.mark.parametrize("shift", [0.2, 0.3])
def test_a_figure_close_to_its_limit_is_undecided(shift):
    """A better estimate decides, one way or the other."""
    assert verdict(draws=changes(shift, error=0.04))[0] == "undecided"
    decided = "accepted" if shift < 0.25 else "reweight"
    assert verdict(draws=changes(shift, error=0.01))[0] == decided
    words = verdict(draws=changes(shift, error=0.04))[1]
    assert "too close to the limit for its error: more FEM runs" in words


def test_reweighting_must_be_known_to_repair():
    beyond = changes(0.6)
    assert verdict(draws=beyond, corrected=changes(0.2, error=0.04))[0] == "undecided"


def test_a_heavy_tail_is_undecided_and_an_irregular_map_is_not_certified():
    heavy = replace(RIGHT.tail, k_hat=0.8, largest=20.0)
    assert verdict(tail=heavy)[0] == "undecided"
    assert verdict(tail=replace(heavy, largest=2.0))[0] == "accepted"  # k-hat cries wolf
    # Few runs have no tail of their own; where the map is FEM's to a tenth, the pool's decides.
    few = replace(RIGHT.tail, k_hat=np.nan, spread=0.2)
    found, words = verdict(tail=few)
    assert found == "undecided"
    assert "too few FEM runs to judge the tail of their weights: 100 FEM runs or more" in words
    assert verdict(tail=replace(few, spread=np.nan))[0] == "undecided"
    same = replace(few, spread=0.05)
    assert verdict(tail=same)[0] == "accepted"
    assert verdict(tail=replace(same, largest=7.0))[0] == "undecided"
    assert verdict(tail=replace(same, pool=50.0))[0] == "undecided"
    assert verdict(tail=replace(RIGHT.tail, pool=50.0))[0] == "undecided"
    assert verdict(tail=replace(RIGHT.tail, spread=3.0))[0] == "not certified"
    assert verdict(tail=replace(RIGHT.tail, spread=np.inf, ess=0.0))[0] == "not certified"


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"r_hat": 1.2}, "the chains disagree, R-hat 1.200"),
        ({"r_hat": np.nan}, "R-hat is not a number"),
        ({"vary": False, "r_hat": np.nan}, "the draws of a parameter do not vary"),
        ({"divergences": 40}, "40 of 4000 transitions diverged"),
        ({"ess_bulk": 40.0}, "too few effective draws, 40 in the bulk"),
        ({"ess_tail": np.nan}, "too few effective draws"),
    ],
)
def test_bad_draws_are_not_certified(entries, words):
    found, said = sampling(**entries)
    assert found == "not certified"
    assert words in said


def test_a_few_divergences_are_forgiven():
    assert sampling(divergences=8)[0] == "accepted"


def test_misfit_is_not_certified_and_names_what_lies_out():
    bad = Misfit(0.0, 0.0, {"displacement[3, 1]": 7.2})
    found, said = verdict(misfit={"displacement": bad})
    assert found == "not certified"
    assert "displacement does not fit, posterior predictive p 0.000" in said
    assert "displacement[3, 1] by 7.2 sd" in said
    worst = Misfit(0.2, 0.0, {})
    assert verdict(misfit={"displacement": worst})[0] == "not certified"
    close = verdict(misfit={"volume": Misfit(1.0, 0.5, {})})
    assert close[0] == "not certified"
    assert "its noise sd is too large" in close[1]
    assert verdict(misfit={"volume": Misfit(np.nan, 0.5, {})})[0] == "not certified"


def test_unphysical_draws_are_not_certified():
    failing = replace(RIGHT.physics, failed=20, failed_mass=0.1)
    assert "FEM fails on 10 % of the posterior" in verdict(physics=failing)[1]
    saddle = replace(RIGHT.physics, unstable=2)
    found, said = verdict(physics=saddle)
    assert found == "not certified"
    assert "a saddle at 2 of 20 draws" in said


def test_json_has_every_figure_with_its_error():
    written = judge(RIGHT).to_json()
    assert written["shift"] == {"x": 0.0}
    assert written["shift_error"] == {"x": 0.01}
    assert written["mean_fem"] == {"x": 1.0}
    assert written["misfit"]["displacement"]["p"] == 0.4


def test_a_wrong_map_is_named_before_the_chains_that_disagree_on_it():
    wrong = {"reaction:right:x@s1": 0.1, "reaction:right:x@s4": 5.2}
    bad = replace(RIGHT.sampling, r_hat=1.5, ess_bulk=7.0)
    certificate = judge(replace(RIGHT, map_errors=wrong, sampling=bad))
    assert certificate.verdict == "not certified"
    assert certificate.reason == (
        "the forward map misses FEM by 5.2 noise sd in reaction:right:x@s4 at the draws"
    )
    first, *rest = certificate.findings
    assert "infer with --forward rounds (FEM where the posterior is) or corrected" in first
    assert "the chains disagree, R-hat 1.500: mend the map first" in rest
    assert "draw" not in rest[1].partition(": ")[2]
    assert certificate.to_json()["map_errors"] == wrong


def test_a_wrong_map_is_named_last_where_fem_repairs_it_and_decides_nothing_by_itself():
    wrong = {"x": 2.0}
    assert judge(replace(RIGHT, map_errors=wrong)).findings == judge(RIGHT).findings
    moved = judge(replace(RIGHT, map_errors=wrong, draws=changes(0.6)))
    alone = judge(replace(RIGHT, draws=changes(0.6)))
    assert moved.verdict == alone.verdict == "reweight"
    assert moved.findings[0] == alone.findings[0]
    (named,) = set(moved.findings) - set(alone.findings)
    assert named.startswith("the forward map misses FEM by 2 noise sd in x")
    open_ = judge(replace(RIGHT, map_errors=wrong, draws=changes(0.25, error=0.04)))
    assert (open_.verdict, open_.findings[0][:22]) == ("undecided", "the forward map misses")
    assert "R-hat 1.500: draw more" in " ".join(
        judge(
            replace(RIGHT, map_errors={"x": 0.3}, sampling=replace(RIGHT.sampling, r_hat=1.5))
        ).findings
    )


def test_a_figure_at_its_limit_is_seldom_within_it_at_one_of_three_looks():
    """Each look has fresh tests, hence an error of its own; 2.4 % by the normal distribution."""
    errors = np.random.default_rng(0).normal(size=(40_000, 3))
    within = [any(Figure(10.0 + e, 1.0).within(10.0) for e in looks) for looks in errors]
    assert np.mean(within) == pytest.approx(0.0244, abs=4 * np.sqrt(0.0244 / 40_000))


@pytest.mark.parametrize(("said", "remedy"), [(NOBODY_SAID, True), (SAID_HOMOGENEOUS, False)])
def test_a_specimen_without_grips_is_accepted_on_an_assumption_that_is_named(said, remedy):
    mesh = MeshChange(why="its states are homogeneous on any mesh", homogeneous=said)
    certificate = judge(replace(RIGHT, mesh=mesh))
    assert certificate.verdict == "accepted"
    assert certificate.reason.endswith(f"if the piece deforms evenly, {said}")
    assert certificate.findings[-1].startswith(
        f"grips: the piece is taken to deform evenly, {said}"
    )
    assert ("give [grips] in the scene file" in certificate.findings[-1]) is remedy
    assert "any mesh" not in " ".join(certificate.findings)


def test_inferred_noise_is_told_as_a_share_of_the_signal():
    small = TakenUp("stress", "kPa", 0.1, 10.0, 0.08, 0.3)
    large = replace(small, sd=2.0)
    assert "of stress is 0.1 kPa, 1 % of the largest (10 kPa)" in verdict(noise=(small,))[1]
    found, words = verdict(noise=(large,))
    assert found == "accepted"
    assert "is 2 kPa, 20 % of the largest" in words
    assert "the law misses the data by more than they scatter" in words
    assert "the law misses" not in verdict(noise=(small,))[1]
