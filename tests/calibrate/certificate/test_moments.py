import numpy as np
import pytest

from calibrate.certificate.moments import jackknife, moments


def test_moments_of_weighted_points():
    """Weights 1, 2, 1 are the points 0, 1, 1, 2."""
    x, weights = np.array([[0.0, 1.0], [1.0, 0.0], [2.0, 5.0]]), np.array([1.0, 2.0, 1.0])
    repeated = x[[0, 1, 1, 2]]
    expected = [
        *repeated.mean(axis=0),
        *np.log(repeated.std(axis=0)),
        np.corrcoef(repeated, rowvar=False)[0, 1],
    ]
    np.testing.assert_allclose(moments(x, weights), expected, rtol=1e-14)
    np.testing.assert_allclose(moments(x, 7.0 * weights), expected, rtol=1e-14)


def test_nothing_has_no_moments():
    assert np.isnan(moments(np.ones((4, 2)), np.zeros(4))).all()


def test_errors_of_a_mean_and_an_sd():
    """sd / sqrt(n), and for a Gaussian's log sd 1 / sqrt(2 n), over repetitions."""
    rng = np.random.default_rng(0)
    found, errors = [], []
    for _ in range(200):
        x = rng.normal(size=(100, 1))
        value, error = jackknife(lambda used, x=x: moments(x, used.astype(float)), 100)
        found.append(value)
        errors.append(error)
    actual = np.std(found, axis=0)
    np.testing.assert_allclose(actual, [0.1, 0.0707], rtol=0.2)
    # A variance of 24 degrees of freedom is uncertain by 14 %, its root by half of that.
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(errors), axis=0)), actual, rtol=0.15)


def test_a_figure_of_equal_points_has_no_error():
    _, error = jackknife(lambda used: np.ones(3)[used[:3]].mean(keepdims=True), 50)
    assert error == pytest.approx(0.0)
