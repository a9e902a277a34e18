"""Ends of ranges that end a posterior: draws of known distributions, cut, touched and open."""

import numpy as np
import pytest
from scipy.special import erf

import calibrate as cal
from calibrate.posterior.box import box_ends, in_words
from calibrate.posterior.diagnosis import diagnose
from calibrate.project.specimen import draft_specimen
from emulator.core.errors import InputError
from emulator.scenes.parameter_space import Parameter
from linear_support import linear_forward

RNG = np.random.default_rng


def one(draws, low=1.0, high=2.0, scale="uniform"):
    return box_ends({"a": draws}, {"a": Parameter("a", "kPa", low, high, scale)})


def normal(mean, sd, count=4000, seed=0):
    """Draws of a normal that is cut to the range 1 to 2."""
    draws = mean + sd * RNG(seed).normal(size=400 * count)
    return draws[(draws > 1.0) & (draws < 2.0)][:count]


@pytest.mark.parametrize("inside", [-3.0, -1.0, 0.0, 0.3])
@pytest.mark.parametrize("at_high", [True, False])
def test_a_normal_that_is_cut_near_its_mode_ends_there(inside, at_high):
    draws = normal(2.0 - 0.05 * inside, 0.05)
    (end,) = one(draws if at_high else 3.0 - draws)
    assert end.value == (2.0 if at_high else 1.0)
    # The whole normal's mean against the cut one's; far outside only a lower bound is told.
    exact = (2.0 - 0.05 * inside - draws.mean()) / draws.std()
    assert end.shift == pytest.approx(min(exact, 3.0), rel=0.4)


def test_the_shift_of_half_a_normal_is_the_integral():
    """Continued by three sd of the draws, M and its centre have closed forms."""
    (end,) = one(normal(2.0, 0.05, count=20_000))
    sd = np.sqrt(1.0 - 2.0 / np.pi)  # of half a normal of sd 1, whose mean is sqrt(2 / pi)
    far = 3.0 * sd
    mass = erf(far / np.sqrt(2.0))
    centre = np.sqrt(2.0 / np.pi) * (1.0 - np.exp(-0.5 * far**2)) / mass
    shift = mass * (centre + np.sqrt(2.0 / np.pi)) / (1.0 + mass)
    assert end.shift == pytest.approx(shift / sd, rel=0.06)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("inside", [1.25, 1.5, 2.0, 3.0, 8.0])
def test_a_tail_that_is_cut_is_no_end(inside, seed):
    assert one(normal(2.0 - 0.05 * inside, 0.05, seed=seed)) == []


def test_what_data_leave_open_claims_nothing():
    assert one(RNG(0).uniform(1.0, 2.0, 4000)) == []
    assert one(RNG(0).uniform(1.3, 1.7, 4000)) == []


def test_half_of_the_range_that_is_left_open_ends_there():
    (end,) = one(RNG(0).uniform(1.5, 2.0, 4000))
    assert str(end) == "a at 2 kPa"


def test_a_log_scale_counts_ratios():
    draws = np.exp(np.log(100.0) * (normal(1.0 + 1.0, 0.05) - 1.0))
    (end,) = one(draws, 1.0, 100.0, "log")
    assert end.value == 100.0


def test_zero_is_no_guess():
    """A range from zero is not widened there."""
    draws = np.abs(0.05 * RNG(0).normal(size=4000))
    assert one(draws, 0.0, 1.0) == []
    assert len(one(1.0 - draws, 0.0, 1.0)) == 1


def test_a_corner_is_seen_where_no_side_is():
    """Correlated by 0.98, with the mode in the corner: each density falls to half at its side."""
    draws = RNG(0).multivariate_normal([0.0, 0.0], [[1.0, 0.98], [0.98, 1.0]], size=400_000)
    draws = 2.0 + 0.05 * draws
    draws = draws[((draws < 2.0) & (draws > 1.0)).all(axis=1)][:4000]
    box = {name: Parameter(name, "", 1.0, 2.0) for name in "ab"}
    ends = box_ends(dict(zip("ab", draws.T, strict=True)), box)
    assert {(end.name, end.value) for end in ends} == {("a", 2.0), ("b", 2.0)}
    words, remedy = in_words(ends)
    assert words.startswith("a corner of the box ends the posterior, not the data: a at 2, b at 2")
    assert "--bounded" in remedy
    assert "--forward rounds" in remedy


def test_a_ridge_across_the_box_is_none_and_a_short_one_is():
    box = {name: Parameter(name, "", 1.0, 2.0) for name in "ab"}
    noise = 0.01 * RNG(1).normal(size=(2, 4000))
    for length, is_cut in ((1.0, False), (0.2, True)):
        along = RNG(0).uniform(0.0, length, 4000)
        draws = np.stack([2.0 - length + along, 2.0 - along]) + noise
        draws = draws[:, ((draws < 2.0) & (draws > 1.0)).all(axis=0)]
        assert bool(box_ends({"a": draws[0], "b": draws[1]}, box)) == is_cut


@pytest.mark.parametrize(("inside", "is_cut"), [(2.1, False), (0.3, True)])
def test_a_thin_ridge_that_touches_an_end_is_not_cut_by_it(inside, is_cut):
    """An end 2.1 sd away moves a mean by 0.05 sd; lines across the ridge end 30 of its sd away."""
    along, across = RNG(2).normal(size=(2, 8000)) * [[0.05], [0.0087]]
    a = 2.0 - 0.05 * inside + along
    draws = np.stack([a, 1.5 + 0.15 * along + across])[:, a < 2.0]
    box = {name: Parameter(name, "", 1.0, 2.0) for name in "ab"}
    assert bool(box_ends({"a": draws[0], "b": draws[1]}, box)) == is_cut


def test_degenerate_draws_have_no_ends():
    assert one(np.full(100, 2.0)) == []
    assert box_ends({"a": RNG(0).normal(size=100)}, {}) == []


@pytest.fixture
def model(beam):
    return lambda **more: cal.model(
        linear_forward(beam),
        cal.nodal_displacements(beam, [3, 11]),
        cal.GaussianNoise(sd=0.2),
        **more,
    )


def test_a_range_is_a_box_unless_something_else_is_said(model, beam):
    assert list(model().box) == ["mu", "lam"]
    assert list(model(bounded=("mu",)).box) == ["lam"]
    assert list(model(prior={"mu": cal.priors.box_prior(beam)["mu"]}).box) == ["lam"]
    assert list(model(known={"lam": 70.0}).box) == ["mu"]
    with pytest.raises(InputError, match="bounded: 'nu' is not inferred; inferred: mu, lam"):
        model(bounded=("nu",))


def test_data_that_want_more_than_the_box_are_told(beam, model):
    """Nearly noise-free data of a body softer than the range: a warning, unless nature ends there."""
    exact = linear_forward(beam).at(np.array([3, 11]))(beam.centre.at[0].set(44.0))
    options = cal.samplers.NUTSOptions(warmup=200, draws=300, chains=2, rounds=1)
    for bounded in ((), ("mu", "lam")):
        posterior = cal.sample(
            model(bounded=bounded, check_scale=False), exact, options=options, predictions=False
        )
        said = [s for s in posterior.warnings() if "ends the posterior, not the data" in s]
        assert bool(said) == (not bounded)
        learned = cal.identify(posterior)
        assert bool(learned["box_ends"]) == (not bounded)
        if not bounded:
            assert not any("mu" in entry["exponents"] for entry in learned["combinations"])


def test_a_cut_posterior_is_not_advised_to_narrow_a_prior():
    rng = RNG(0)
    draws = {"a": rng.normal(size=(4, 100))}
    diverging = {"diverging": rng.random((4, 100)) < 0.2}
    row = {"a": {"r_hat": 1.0, "ess_bulk": 500.0, "ess_tail": 500.0}}
    ends = one(normal(2.0, 0.05))
    for box, words in ((ends, "widen the box"), ((), "a prior that leaves out")):
        assert any(words in sentence for sentence in diagnose(draws, diverging, row, {}, box))


def apart(rng, sd):
    """Posteriors of several modes, an arc and an L, nine sd or more from every end."""
    square = np.array([[0.25, 0.25], [0.25, 0.75], [0.75, 0.25], [0.75, 0.75]])
    for upper in (0.5, 0.8, 0.95):
        low = rng.random(4000) > upper
        yield np.column_stack([np.where(low, 0.25, 0.75), np.full(4000, 0.5)])
    yield square[rng.integers(3, size=4000)]
    s = rng.random(4000)
    yield 0.5 + 0.3 * np.column_stack([np.cos(1.5 * np.pi * s), np.sin(1.5 * np.pi * s)])
    yield np.where((s < 0.5)[:, None], np.column_stack([0.2 + s, 0 * s + 0.3]),
                   np.column_stack([0 * s + 0.3, s - 0.2]))  # fmt: skip


@pytest.mark.parametrize("sd", [0.003, 0.01, 0.02])
def test_an_end_without_a_draw_near_it_ends_nothing(sd):
    rng = np.random.default_rng(3)
    box = {name: Parameter(name, "kPa", 1.0, 2.0) for name in "ab"}
    for places in apart(rng, sd):
        x = 1.0 + places + sd * rng.normal(size=places.shape)
        assert box_ends({"a": x[:, 0], "b": x[:, 1]}, box) == []


def test_a_mode_that_is_cut_ends_there_beside_one_that_is_not():
    rng = np.random.default_rng(4)
    box = {"a": Parameter("a", "kPa", 1.0, 2.0)}
    cut = 1.0 + np.abs(0.02 * rng.normal(size=2000))
    (end,) = box_ends({"a": np.concatenate([cut, 1.2 + 0.02 * rng.normal(size=2000)])}, box)
    assert (end.name, end.value) == ("a", 1.0)


def test_an_end_at_a_limit_of_nature_ends_no_posterior(tmp_path):
    """A dispersion of fibres is 1/3 at most, and ``init`` writes a range up to 0.33."""
    table = "stretch_x,stretch_y,stress_x,stress_y\n1,1,0,0\n1.1,1.1,5,4\n1.2,1.2,30,20\n"
    (tmp_path / "t.csv").write_text(table)
    scene = draft_specimen(
        tmp_path / "t.csv", tmp_path / "x.toml", law="gasser_ogden_holzapfel"
    ).scene
    (parameter,) = (p for p in scene.parameters if p.name == "dispersion")
    quantity = scene.quantities["dispersion"]
    draws = {"dispersion": parameter.high - 0.03 * np.abs(RNG(0).normal(size=4000))}
    box = {"dispersion": parameter}
    assert box_ends(draws, box, {"dispersion": quantity}) == []
    assert box_ends(draws, box) != []
