"""A mode that the map hides and no draw has seen: FEM's own derivatives lead there."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
from calibrate.certificate.runs import FEMRunner, descend
from calibrate.statistical_model import FEMLikelihood
from calibrate.statistical_model.predictive import Predictive
from certificate_support import grid_of, linear_model, posterior_of
from emulator.core.display import counting
from linear_support import LinearForward, LinearSimulator, Step, linear_forward

APART = 12.0  # kPa from the plane mu = 75 to each of two modes
TRUTH = (63.0, 68.0)


@dataclass(frozen=True, eq=False)
class Even(LinearForward):
    """Linear in ``(mu - 75)^2``, with the slope of the linear map at the modes."""

    def __call__(self, theta):
        off = theta[0] - 75.0
        folded = 75.0 - 0.5 * (off**2 / APART + APART)
        return super().__call__(jnp.stack([folded, theta[1]]))


@pytest.fixture(scope="module")
def fem(beam):
    return linear_forward(beam, size=0.02, of=Even)


@pytest.fixture(scope="module")
def posterior(beam, fem):
    """Draws of the lower mode; the map is ten noise sd wrong around the other."""
    right = linear_model(beam, forward=fem)
    rng = np.random.default_rng(3)
    data = np.asarray(right.forward(jnp.asarray(TRUTH))) + rng.normal(0.0, 0.1, (3, 3))
    points = grid_of(200)
    folded = points.copy()
    folded[:, 0] = 75.0 - 0.5 * ((points[:, 0] - 75.0) ** 2 / APART + APART)
    A, b = np.asarray(right.forward.matrix).reshape(-1, 2), np.asarray(right.forward.shift).ravel()
    log = -0.5 * ((folded @ A.T + b - data.ravel()) ** 2).sum(1) / 0.1**2 - np.log(points).sum(1)
    weights = np.exp(log - log.max()) * (points[:, 0] < 75.0)
    rows = rng.choice(len(points), size=4000, p=weights / weights.sum())
    draws = points[rows] + rng.uniform(-0.125, 0.125, (4000, 2))
    return posterior_of(linear_model(beam, forward=Step(fem, 75.0)), data, draws)


def test_descents_end_at_the_mode_that_the_map_hides(fem, posterior):
    predictive, rng = Predictive(posterior.model, posterior.data), np.random.default_rng(0)
    z = predictive.unconstrain(posterior.draws())
    with counting(total=1, desc="", disable=True, unit="run") as bar:
        likelihood = FEMLikelihood(posterior.model, LinearSimulator(fem))
        solver = FEMRunner(predictive, likelihood, bar)
        starts = z[:1] + np.array([[0.0, 2.2], [1.0, 1.9], [-0.5, 3.0]])  # lam, mu
        runs, modes = descend(solver, solver(starts, slopes=True), solver(z[:1]), z, 12, rng)
    assert len(runs.z) <= 12
    assert len(modes) == 1
    ends = predictive.constrain(modes[0])
    mean = {name: values.mean() for name, values in posterior.draws().items()}
    assert abs(ends["mu"].mean() - (150.0 - mean["mu"])) < 1.0
    assert abs(ends["lam"].mean() - mean["lam"]) < 1.0


def test_gradient_and_curvature_are_those_of_differences(fem, posterior):
    predictive = Predictive(posterior.model, posterior.data)
    z = predictive.unconstrain({"mu": np.array([83.0]), "lam": np.array([71.0])})[0]
    with counting(total=1, desc="", disable=True, unit="run") as bar:
        likelihood = FEMLikelihood(posterior.model, LinearSimulator(fem))
        solver = FEMRunner(predictive, likelihood, bar)
        here = solver(z[None], slopes=True)
        np.testing.assert_array_equal(solver(z[None]).fem, here.fem)  # known: nothing to solve
        apart = FEMRunner(predictive, FEMLikelihood(posterior.model, LinearSimulator(fem)), bar)
        assert apart(z[None]).slopes == (None,)
        later = replace(apart)(z[None], slopes=True)  # as tests that train the next correction
        np.testing.assert_allclose(later.slopes[0], here.slopes[0])
        np.testing.assert_allclose(later.means, here.means)
        ahead, behind = (solver(z + sign * 1e-4 * np.eye(2)) for sign in (1.0, -1.0))
    prior, gradient, curvature = predictive.curvature(z, here.means[0], here.slopes[0])

    def log_prior(points):
        return predictive.by_map(points)[0]

    assert prior == pytest.approx(log_prior(z[None])[0])
    rise = log_prior(ahead.z) + ahead.fem - log_prior(behind.z) - behind.fem
    np.testing.assert_allclose(gradient, rise / 2e-4, rtol=1e-5)
    J = (ahead.means - behind.means).T / 2e-4
    wanted = J.T @ J / 0.1**2 + np.diag(predictive.prior_sd**-2)
    np.testing.assert_allclose(curvature, wanted, rtol=1e-5)


@pytest.mark.parametrize("draws", [60, 150])
def test_a_hidden_mode_is_not_accepted(fem, posterior, draws):
    certificate = cal.certify(posterior, LinearSimulator(fem), draws=draws)
    assert certificate.verdict != "accepted"
    assert certificate.evidence.tail.ends == 1
