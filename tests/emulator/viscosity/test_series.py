"""Fractions and times of relaxations, against the exponential integral and by construction."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import exp1

from emulator.core.errors import InputError
from emulator.viscosity.series import Viscosity


def relaxation(series, t):
    """G at times t (n,) s."""
    left = 1.0 - np.exp(-t[:, None] / np.asarray(series.times))
    return 1.0 - left @ np.asarray(series.fractions)


@pytest.mark.parametrize(("decades", "error"), [(3, 2e-7), (5, 3e-5)])
def test_a_spectrum_is_fungs(decades, error):
    c, tau_1, tau_2 = 0.3, 0.05, 0.05 * 10.0**decades
    L = np.log(tau_2 / tau_1)
    series = Viscosity("spectrum").series({"spectrum": c, "tau_1": tau_1, "tau_2": tau_2})
    t = np.geomspace(1e-3 * tau_1, 10.0 * tau_2, 400)
    exact = (1.0 + c * (exp1(t / tau_2) - exp1(t / tau_1))) / (1.0 + c * L)
    relaxed = c * L / (1.0 + c * L)
    assert float(series.fractions.sum()) == pytest.approx(relaxed, abs=1e-14)
    worst = np.abs(relaxation(series, t) - exact).max() / relaxed
    assert 0.1 * error < worst < error
    swapped = Viscosity("spectrum").series({"spectrum": c, "tau_1": tau_2, "tau_2": tau_1})
    np.testing.assert_allclose(relaxation(swapped, t), relaxation(series, t), atol=1e-12)


def test_fractions_of_any_values_leave_something():
    values = {"relaxation_1": 0.5, "tau_1": 1.0, "relaxation_2": 0.9, "tau_2": 10.0}
    values |= {"relaxation_3": 0.99, "tau_3": 100.0}
    series = Viscosity("prony", 3).series({n: jnp.asarray(x) for n, x in values.items()})
    np.testing.assert_allclose(series.fractions, [0.5, 0.45, 0.0495], atol=1e-15)
    assert 1.0 - float(series.fractions.sum()) == pytest.approx(0.5 * 0.1 * 0.01)
    np.testing.assert_array_equal(series.times, [1.0, 10.0, 100.0])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"kind": "maxwell"}, "kind 'maxwell'; use prony or spectrum"),
        ({"terms": 0}, "0 terms of kind 'prony'; give 1 to 6"),
        ({"terms": 7}, "7 terms"),
    ],
)
def test_other_relaxations_are_refused(words, message):
    with pytest.raises(InputError, match=message):
        Viscosity(**words)
