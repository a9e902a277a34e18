import jax
import numpy as np
import pytest

import calibrate as cal
from calibrate.certificate.correction import nothing
from calibrate.certificate.misfit import misfits
from calibrate.certificate.predictive import Predictive
from calibrate.posterior.fit import Misfit
from certificate_support import exact_data, grid_of, linear_model, quadrature
from linear_support import linear_forward

MANY = list(range(5, 45))


def found(beam, change=None, sd=0.1, seed=0):
    """Misfit of data with noise of 0.1 mm, ``change`` made to it, under a model of ``sd``."""
    model = linear_model(beam, sd, nodes=MANY)
    data = exact_data(model, seed)
    if change is not None:
        change(data)
    points, rng = grid_of(), np.random.default_rng(seed)
    rows = rng.choice(len(points), size=400, p=quadrature(model.full, data, sd, points, MANY))
    predictive = Predictive(model, {"displacement": data})
    z = predictive.unconstrain({"mu": points[rows, 0], "lam": points[rows, 1]})
    return misfits(predictive, nothing(1, 2, 120), z, jax.random.key(seed))["displacement"]


def test_data_of_the_model_fits(beam):
    values = [found(beam, seed=seed).p for seed in (0, 3)]
    assert 0.05 < min(values) < max(values) < 0.98


def test_the_p_value_is_that_of_chi_squared(beam):
    """At one theta and a known sd, T_1 of simulated data is chi squared, here with 9 degrees."""
    from scipy.stats import chi2

    model = linear_model(beam)
    data = exact_data(model, 3)
    predictive = Predictive(model, {"displacement": data})
    z = np.repeat(
        predictive.unconstrain({"mu": np.array([72.0]), "lam": np.array([68.0])}), 4000, 0
    )
    p = misfits(predictive, nothing(1, 2, 9), z, jax.random.key(0))["displacement"].p
    residual = data - np.asarray(model.forward(np.array([72.0, 68.0])))
    exact = chi2.sf((residual**2).sum() / 0.1**2, 9)
    assert abs(p - exact) < 4 * np.sqrt(exact * (1 - exact) / 4000)


def test_an_outlier_is_found_and_named(beam):
    def spoil(data):
        data[1, 2] += 1.0

    result = found(beam, spoil)
    assert result.p < 0.005
    assert next(iter(result.outlying)) == "displacement[1, 2]"


def test_a_wrong_noise_sd_is_found_on_either_side(beam):
    assert found(beam, sd=0.07).p < 0.005
    assert found(beam, sd=0.15).p > 0.995


def test_an_inferred_noise_and_a_single_number(beam):
    """Nothing to compare a single number's noise with: it always fits."""
    forward = linear_forward(beam, size=0.02)
    observe = cal.nodal_displacements(beam, [3])
    model = cal.model(forward, observe, cal.GaussianNoise(sd_scale=1.0))
    data = np.asarray(forward.at(observe.nodes)(np.array([72.0, 68.0])))
    predictive = Predictive(model, {"displacement": data})
    draws = {"mu": np.full(300, 72.0), "lam": np.full(300, 68.0), "noise_sd": np.full(300, 0.2)}
    result = misfits(predictive, nothing(1, 2, 3), predictive.unconstrain(draws), jax.random.key(0))
    assert result["displacement"].p == pytest.approx(1.0)
    assert not result["displacement"].outlying


def test_a_single_number_is_compared_too():
    rng = np.random.default_rng(0)
    simulated = np.abs(rng.normal(size=(500, 1)))
    near = Misfit.of(["volume"], np.ones(500), simulated, np.full((500, 1), 0.5))
    assert near.p_worst > 0.5
    far = Misfit.of(["volume"], np.zeros(500), simulated, np.full((500, 1), 6.0))
    assert list(far.outlying) == ["volume"]
    assert far.p_worst == 0.0
