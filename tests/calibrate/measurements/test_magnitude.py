"""Data in a wrong unit is refused in one line; right data, however noisy, is not."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
from calibrate.measurements import Observations
from calibrate.measurements.magnitude import (
    PRIOR_DRAWS,
    check_magnitudes,
    complaint,
    predict_over_prior,
)
from calibrate.statistical_model.many_draws import means_at_rows
from emulator.core.errors import InputError
from linear_support import linear_forward

NODES = [3, 11, 20, 30]


@pytest.fixture(scope="module")
def forward(beam):
    """Displacements between about 5 and 10 mm over the box."""
    return linear_forward(beam, size=0.05)


@pytest.fixture(scope="module")
def model(forward, beam):
    observe = cal.nodal_displacements(beam, NODES)
    return cal.model(forward, observe, cal.GaussianNoise(sd=0.2))


@pytest.fixture(scope="module")
def exact(forward):
    return np.asarray(forward.at(np.array(NODES))(jnp.array([72.0, 68.0])))


def over_prior(model):
    draws = model.prior_draws(jax.random.key(0), PRIOR_DRAWS)
    stacked = np.stack([np.asarray(draws[name]) for name in model.names[: len(draws)]], axis=1)
    return predict_over_prior(partial(means_at_rows, model), model.observe, stacked)


@pytest.mark.parametrize(
    ("factor", "message"),
    [
        (1e-3, r"about 1000 times smaller .* m instead of mm\? multiply by 1000"),
        (0.1, r"about 10 times smaller .* cm instead of mm\? multiply by 10 "),
        (1e3, r"about 1000 times larger .* µm instead of mm\? multiply by 0.001"),
        (0.0, "displacement data are all zero; predictions reach"),
        (60.0, r"larger .* pixels instead of mm\? multiply by the size of a pixel in mm \("),
        (1e9, "times larger .* check their unit, and that they belong to this scene"),
        (1e200, "times larger"),
    ],
)
def test_units_that_are_wrong_by_a_factor(model, exact, factor, message):
    with pytest.raises(InputError, match=message) as caught:
        model.check_data(factor * exact)
    assert "\n" not in str(caught.value)
    assert "--no-unit-check" in str(caught.value)


def test_an_inferred_noise_does_not_hide_a_wrong_unit(forward, beam, exact):
    observe = cal.nodal_displacements(beam, NODES)
    model = cal.model(forward, observe, cal.GaussianNoise(sd_scale=0.2))
    with pytest.raises(InputError, match="m instead of mm"):
        model.check_data(1e-3 * exact)


def test_the_check_can_be_overruled(forward, beam, exact):
    observe = cal.nodal_displacements(beam, NODES)
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.2), check_scale=False)
    np.testing.assert_array_equal(model.check_data(1e-3 * exact)["displacement"], 1e-3 * exact)


@pytest.mark.parametrize("sd", [0.01, 1.0, 5.0, 50.0, 1e4])
def test_noise_alone_never_makes_data_refused(forward, beam, sd):
    """Truths all over the box, its corners among them."""
    rng = np.random.default_rng(0)
    observe = cal.nodal_displacements(beam, NODES)
    model = cal.model(forward, observe, cal.GaussianNoise(sd=sd))
    predictions = over_prior(model)["displacement"]
    low, high = (np.array([getattr(p, end) for p in beam.parameters]) for end in ("low", "high"))
    corners = [low, high, np.array([low[0], high[1]]), np.array([high[0], low[1]])]
    for theta in [*corners, *rng.uniform(low, high, (200, 2))]:
        data = np.asarray(model.forward(jnp.asarray(theta))) + rng.normal(0.0, sd, (4, 3))
        assert complaint("displacement", observe, data, predictions, sd) is None


def test_the_smallest_and_the_largest_prediction_are_among_those_made(model, beam):
    norms = np.linalg.norm(over_prior(model)["displacement"].reshape(-1, 12), axis=1)
    box = [(p.low, p.high) for p in beam.parameters]
    grid = np.stack(np.meshgrid(*[np.linspace(*side, 9) for side in box]), axis=-1).reshape(-1, 2)
    every = [np.linalg.norm(model.forward(jnp.asarray(theta))) for theta in grid]
    assert norms.min() == pytest.approx(min(every), rel=0.02)
    assert norms.max() == pytest.approx(max(every), rel=0.02)


@pytest.mark.parametrize("pair", [(0, 1), (0, 2), (1, 2)])
def test_columns_that_are_swapped_are_named(model, forward, exact, pair):
    """One camera sees no z; noise as large as the signal says nothing."""
    swapped, words = exact.copy(), f"columns u{'xyz'[pair[0]]} and u{'xyz'[pair[1]]} swapped: put"
    swapped[:, pair] = exact[:, pair[::-1]]
    with pytest.raises(InputError, match=words):
        model.given(swapped)
    if pair == (0, 1):
        with pytest.raises(InputError, match=words):
            model.given(np.where([True, True, False], swapped, np.nan))
    with pytest.raises(InputError, match=f"sign of u{'xyz'[pair[1]]} reversed: put"):
        model.given(np.where(np.arange(3) == pair[1], -exact, exact))
    noisy = cal.model(forward, model.observe, cal.GaussianNoise(sd=np.abs(exact).max()))
    noisy.check_data(swapped)


def test_columns_in_order_are_taken_whatever_the_noise(model, forward):
    """Data at draws of the prior, with a tenth, a half and all of their size as noise."""
    rng = np.random.default_rng(5)
    for share in (0.1, 0.5, 1.0):
        for theta in rng.uniform(50.0, 100.0, (20, 2)):
            u = np.asarray(forward.at(np.array(NODES))(jnp.array(theta)))
            sd = share * np.sqrt(np.mean(u**2))
            noisy = cal.model(forward, model.observe, cal.GaussianNoise(sd=sd))
            noisy.check_data(u + rng.normal(0.0, sd, u.shape))


def test_a_body_that_may_be_at_rest_explains_small_data(beam):
    observe = cal.nodal_displacements(beam, NODES)
    g = np.stack([np.zeros((4, 3)), np.ones((4, 3))])
    assert complaint("displacement", observe, np.full((4, 3), 1e-6), g, 1e-9) is None


def test_a_second_mode_is_no_other_unit(beam):
    """A narrow hill in the box of the prior: ten times the displacement of all the rest."""
    observe = Observations({"displacement": cal.nodal_displacements(beam, NODES)})
    sd = {"displacement": 0.1}

    def predict(x):
        hill = jnp.exp(-0.5 * jnp.sum((x - 0.21) ** 2) / 0.06**2)
        return {"displacement": jnp.ones((4, 3)) * (1.0 + 9.0 * hill)}, jnp.array(True)

    draws = np.random.default_rng(1).random((PRIOR_DRAWS, 3))
    many = lambda rows: jax.tree.map(np.asarray, jax.vmap(predict)(jnp.asarray(rows)))
    predictions = predict_over_prior(many, observe, draws)
    check = partial(check_magnitudes, predict, observe, sd, draws)
    check({"displacement": np.full((4, 3), 10.0)}, predictions)
    with pytest.raises(InputError, match="larger than predicted .* against 1 to 10 mm"):
        check({"displacement": np.full((4, 3), 40.0)}, predictions)


def test_one_outlier_is_no_wrong_unit(model, exact):
    outlying = exact.copy()
    outlying[1, 2] += 2.0 * np.abs(exact).max()
    model.check_data(outlying)


def test_a_volume_in_another_unit(ventricle):
    forward = linear_forward(ventricle, size=0.05)
    model = cal.model(forward, cal.CavityVolume(ventricle), cal.GaussianNoise(sd=1.0))
    rest = float(model.observe.parts["volume"].cavity.rest)
    model.check_data(1.2 * rest)
    for factor, unit, repair in ((1e3, "mm3", "0.001"), (1e-3, "L", "1000")):
        with pytest.raises(InputError, match=f"{unit} instead of mL. multiply by {repair}"):
            model.check_data(1.2 * factor * rest)


def test_a_map_without_any_answer_says_so(beam):
    from dataclasses import replace

    forward = replace(linear_forward(beam), limit=10.0)
    model = cal.model(forward, cal.nodal_displacements(beam, NODES), cal.GaussianNoise(sd=0.2))
    with pytest.raises(InputError, match="the forward map has no valid answer at any of 32 draws"):
        model.check_data(np.ones((4, 3)))
