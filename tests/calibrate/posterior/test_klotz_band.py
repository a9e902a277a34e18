"""Curves of a prior in the band of Klotz's relation."""

import jax
import numpy as np
import pytest

import calibrate as cal
from emulator.core.errors import InputError
from klotz_support import PRESSURE, PRIOR, VOLUME, lengthening, model_of


@pytest.fixture(scope="module")
def larger(ventricle):
    """Curves of Klotz's shape, some mL too large at 1.3 kPa."""
    return model_of(lengthening(ventricle), {"a": PRIOR["a"]}, b=1.0, pressure=1.0)


def printed(volumes, volume, pressure):
    """Pressures in kPa of the relation through a point, as printed, with A_n that cancels."""
    mmhg = pressure / 0.133322
    rest = volume * (0.6 - 0.006 * mmhg)
    at_30 = rest + (volume - rest) / (mmhg / 27.78) ** (1.0 / 2.76)
    return 0.133322 * 27.78 * ((volumes - rest) / (at_30 - rest)) ** 2.76


def test_how_far_curves_are_apart_is_what_the_printed_relation_says(larger):
    band, parameter = 0.3, larger.forward.scene.parameters[-1]
    a = np.asarray(larger.prior_draws(jax.random.key(3), 40)["a"])
    p = np.linspace(parameter.low, parameter.high, 12)
    rest = 0.6 - 0.006 * PRESSURE / 0.133322
    volumes = (VOLUME + a)[:, None] * (rest + (1.0 - rest) * (p / PRESSURE) ** (1.0 / 2.76))
    # Through one measured point: volumes of all pressures are too large by one share.
    found = cal.klotz_band(larger, cal.Klotz(VOLUME, PRESSURE), band=band, count=40, seed=3)
    expected = np.abs(printed(volumes, VOLUME, PRESSURE) - p).max(axis=1)
    np.testing.assert_allclose(found.apart, expected, rtol=1e-8)
    assert 0.0 < found.fraction == np.mean(expected <= band) < 1.0
    # Through each curve's own last point, beside the one that its volumes were made with.
    own = cal.klotz_band(larger, count=40, seed=3)
    expected = np.abs(printed(volumes, volumes[:, -1:], p[-1]) - p).max(axis=1)
    np.testing.assert_allclose(own.apart, expected, rtol=1e-6)
    assert expected.max() < 2e-3
    assert (own.fraction, own.left_out) == (1.0, 0)


def test_curves_of_another_shape(ventricle):
    model = model_of(lengthening(ventricle), {"b": PRIOR["b"]}, a=1.0, pressure=1.0)
    found = cal.klotz_band(model, band=0.02, count=40)
    b = np.asarray(model.prior_draws(jax.random.key(0), 40)["b"])
    near = found.apart <= 0.02
    assert 0.0 < found.fraction < 1.0
    assert np.abs(b[near] - 1.0).max() < np.abs(b[~near] - 1.0).max()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"band": 0.0}, "band 0.0 kPa and 200 draws; both must be above 0"),
        ({"count": 0}, "and 0 draws"),
        ({"state": "ED"}, "load state 'ED' is unknown; known: none"),
        ({"seed": -1}, "klotz: seed -1 is below 0"),
    ],
)
def test_what_is_refused(larger, options, message):
    with pytest.raises(InputError, match=message):
        cal.klotz_band(larger, **options)
