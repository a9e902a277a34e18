"""R-hat and the stopping rule; importance weights and the shapes of known tails."""

import arviz_stats
import numpy as np
import pytest
from scipy.stats import norm

from calibrate.importance.weights import effective, normalised, pareto_shape, smoothed
from calibrate.samplers.diagnostics import converged, r_hat


def test_smoothed_weights_move_draws_to_where_they_point():
    """Draws about 0 weighted as of a Gaussian about 0.7: ArviZ has the opposite sign."""
    x = np.random.default_rng(2).normal(size=20_000)
    log_weights, shape = smoothed(norm.logpdf(x, 0.7, 0.9) - norm.logpdf(x))
    weights = np.exp(log_weights)
    assert weights.sum() == pytest.approx(1.0)
    assert weights @ x == pytest.approx(0.7, abs=0.03)
    assert shape < 0.5


def test_the_shapes_of_known_tails():
    rng = np.random.default_rng(0)
    for shape in (0.3, 0.5, 0.9):
        log_weights = np.log(rng.pareto(1.0 / shape, size=20_000) + 1.0)
        assert pareto_shape(log_weights) == pytest.approx(shape, abs=0.15)


@pytest.mark.parametrize(
    ("log_weights", "shape"),
    [
        (np.full(50, -800.0), 0.0),
        (np.linspace(0.0, 5.0, 24), np.nan),
        # One point, drawn again and again.
        (np.concatenate([np.linspace(-900.0, -300.0, 60), np.zeros(40)]), np.inf),
    ],
)
def test_weights_without_a_tail_stay_as_they_are(log_weights, shape):
    told, found = smoothed(log_weights)
    np.testing.assert_equal(found, shape)
    expected = np.exp(log_weights - log_weights.max())
    np.testing.assert_allclose(np.exp(told), expected / expected.sum(), atol=1e-12)


def test_the_efficiency_of_two_weights():
    # (1 + 3)^2 / (1 + 9)
    assert effective(normalised(np.log([1.0, 3.0]) - 700.0)) == pytest.approx(1.6)


def test_r_hat_of_one_chain_sees_a_drift():
    rng = np.random.default_rng(0)
    still = rng.normal(size=(1, 2000))
    assert r_hat(still) < 1.01
    assert r_hat(still + np.linspace(0.0, 3.0, 2000)) > 1.1
    assert np.isnan(r_hat(still[:, :7]))


def test_r_hat_of_several_chains_is_arviz_s():
    values = np.random.default_rng(1).normal(size=(4, 200))
    values[0] += 1.0
    assert r_hat(values) == pytest.approx(float(arviz_stats.rhat(values)))


def test_the_stopping_rule_asks_for_agreement_and_for_enough_draws():
    z = np.random.default_rng(2).normal(size=(4, 500, 2))
    assert converged(z, 1.01, 400.0)
    assert not converged(z, 1.01, 5000.0)
    z[0, :, 1] += 1.0
    assert not converged(z, 1.01, 400.0)
