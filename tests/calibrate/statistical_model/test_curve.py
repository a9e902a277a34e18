"""The covariance along a loading curve, and the modes that make it."""

import numpy as np
import pytest

from calibrate.statistical_model.curve import check_curve, curve_covariance, curve_modes
from emulator.core.errors import InputError

AT = np.array([0.0, 0.1, 0.3, -0.2])
VALUES = np.array([1.0, 2.0, 4.0, -1.5])


def test_one_entry_by_hand():
    """Points 0.1 and 0.3 apart by one length: (1 + sqrt 3) exp(-sqrt 3) of Matern's kernel."""
    C = curve_covariance(AT, VALUES, 0.2, share=0.1, sd=0.05, constant=0.25)
    near = (1.0 + np.sqrt(3.0)) * np.exp(-np.sqrt(3.0))
    assert C[1, 2] == pytest.approx((0.01 * 8.0 + 0.0025) * (0.25 + 0.75 * near))
    assert C[2, 2] == pytest.approx(0.01 * 16.0 + 0.0025)


@pytest.mark.parametrize("constant", [0.0, 0.5])
def test_modes_make_the_covariance(constant):
    """Of sd 1; as shares of values they make that of a share."""
    V = curve_modes(AT, 0.2, constant=constant)
    C = curve_covariance(AT, VALUES, 0.2, sd=1.0, constant=constant)
    np.testing.assert_allclose(V.T @ V, C, atol=1e-6)
    C = curve_covariance(AT, VALUES, 0.2, share=0.1, constant=constant)
    share = 0.1 * V * VALUES
    np.testing.assert_allclose(share.T @ share, C, atol=1e-6)


def test_a_curve_that_is_off_as_one_has_one_mode():
    assert curve_modes(AT, 0.2, constant=1.0).shape == (1, 4)


def test_what_cannot_be():
    with pytest.raises(InputError, match="length is 0; it must be above 0"):
        check_curve(0, 0.5)
    with pytest.raises(InputError, match=r"constant is 1.5; it is a part, 0 to 1"):
        check_curve(0.1, 1.5)


def test_several_curves_at_once():
    at, values = np.stack([AT, 2.0 * AT]), np.stack([VALUES, -VALUES])
    lengths = np.array([0.2, 0.4])[:, None, None]
    found = curve_covariance(at, values, lengths, share=0.1, constant=0.5)
    for C, a, y, length in zip(found, at, values, (0.2, 0.4), strict=True):
        one = curve_covariance(a, y, length, share=0.1, constant=0.5)
        np.testing.assert_allclose(C, one, rtol=1e-14)
