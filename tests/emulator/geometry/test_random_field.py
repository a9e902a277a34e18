"""Modes of a random field: orthonormal, of unit variance, with Matern's correlation in a sheet."""

import numpy as np
import pytest
from scipy.special import kv

from emulator.core.errors import InputError
from emulator.geometry.discretisation import discretise
from emulator.geometry.generators.box import box
from emulator.geometry.random_field import matern_modes

LENGTH = 8.0


@pytest.fixture(scope="module")
def sheet():
    return box((40.0, 30.0, 1.0), (32, 24, 1))


def test_its_variance_is_one_and_its_correlation_that_of_the_plane(sheet):
    """Away from the edge rho(r) = x K1(x), x = sqrt(8) r / length, which is 0.14 at the length."""
    modes = matern_modes(sheet, LENGTH, 250)
    volumes = discretise(sheet).weights.sum(axis=1)
    variance = np.sum(modes**2, axis=1)
    assert volumes @ variance / volumes.sum() == pytest.approx(1.0, abs=0.03)
    middles = sheet.nodes[sheet.corners].mean(axis=1)[:, :2]
    centre = np.argmin(np.linalg.norm(middles - (20.0, 15.0), axis=1))
    correlation = modes @ modes[centre] / np.sqrt(variance * variance[centre])
    distance = np.linalg.norm(middles - middles[centre], axis=1)
    for r in (2.0, 4.0, LENGTH):
        x = np.sqrt(8.0) * r / LENGTH
        found = correlation[np.abs(distance - r) < 0.7].mean()
        assert found == pytest.approx(x * kv(1, x), abs=0.06), r


def test_it_is_zero_elsewhere_and_the_same_again(sheet):
    left = sheet.nodes[sheet.corners].mean(axis=1)[:, 0] < 15.0
    modes = matern_modes(sheet, LENGTH, 12, left)
    assert not modes[~left].any()
    assert modes[left].any()
    np.testing.assert_array_equal(modes, matern_modes(sheet, LENGTH, 12, left))
    np.testing.assert_allclose(modes[left][:, 0], modes[left][0, 0], rtol=1e-9)  # the constant


@pytest.mark.parametrize(
    ("length", "count", "within", "words"),
    [
        (0.0, 5, None, "length"),
        (8.0, 0, None, "modes"),
        (8.0, 10_000, None, "half of the part's"),
        (8.0, 5, "ends", "2 pieces"),
    ],
)
def test_fields_that_cannot_be_are_refused_in_a_line(sheet, length, count, within, words):
    x = sheet.nodes[sheet.corners].mean(axis=1)[:, 0]
    inside = None if within is None else (x < 10.0) | (x > 30.0)
    with pytest.raises(InputError, match=words) as error:
        matern_modes(sheet, length, count, inside)
    assert "\n" not in str(error.value)
