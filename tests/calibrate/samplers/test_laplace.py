"""The Laplace approximation: exact for a Gaussian posterior, and honest about others."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

import calibrate as cal
from calibrate.samplers import LaplaceOptions
from emulator.core.errors import SolverError
from linear_support import LinearForward, linear_forward, linear_problem


@dataclass(frozen=True, eq=False)
class Bent(LinearForward):
    """Only a curved combination of the two parameters is seen."""

    def __call__(self, theta):
        x, y = (theta[0] - 75.0) / 5.0, (theta[1] - 75.0) / 5.0
        return jnp.ones((len(self.nodes), 3)) * (y - x**2)


def bent(beam):
    forward = linear_forward(beam, of=Bent)
    prior = {name: dist.Normal(75.0, 10.0) for name in beam.parameter_names}
    observe = cal.nodal_displacements(beam, [3])
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.05), prior, check_scale=False)
    return model, np.zeros((1, 3))


def test_of_a_gaussian_posterior_it_is_exact(beam):
    model, data = linear_problem(beam)
    posterior = cal.sample(model, data, sampler="laplace", options=LaplaceOptions(draws=500))
    ratios = posterior.tree["sample_stats"]["log_ratio"].values
    assert np.ptp(ratios) < 1e-5
    assert posterior.tree.attrs["pareto_k"] == 0.0
    assert posterior.tree.attrs["approximation"] == "gaussian"
    assert posterior.warnings() == []


@pytest.mark.slow
def test_the_ratio_of_a_gaussian_is_its_evidence(beam):
    """log p(z, y) - log q(z) is log p(y) where q is the posterior: SMC's estimate of it."""
    model, data = linear_problem(beam)
    laplace = cal.sample(model, data, sampler="laplace", options=LaplaceOptions(draws=50))
    smc = cal.sample(model, data, sampler="smc", seed=3)
    error = smc.tree.attrs["log_evidence_error"]
    found = float(laplace.tree["sample_stats"]["log_ratio"].mean())
    assert found == pytest.approx(smc.tree.attrs["log_evidence"], abs=5.8 * error)


def test_of_a_bent_posterior_it_says_that_it_is_wrong(beam):
    model, data = bent(beam)
    posterior = cal.sample(model, data, sampler="laplace", options=LaplaceOptions(draws=500))
    # Too wide where the posterior bends away: no heavy tail, but hardly a draw that counts.
    assert posterior.tree.attrs["importance_efficiency"] < 0.2
    assert any("the Gaussian approximation is poor" in line for line in posterior.warnings())


def test_a_mode_between_walls_is_refused(beam):
    """A likelihood that grows to where the map ends has no mode before it."""
    from dataclasses import replace

    forward = replace(linear_forward(beam), limit=75.0)
    prior = {name: dist.Uniform(60.0, 80.0) for name in beam.parameter_names}
    observe = cal.nodal_displacements(beam, [3])
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.001), prior, check_scale=False)
    truth = np.asarray(replace(forward, limit=np.inf).at(observe.nodes)(jnp.array([79.0, 79.0])))
    # Round-off decides where the optimiser stops at the wall, and so which of the two is said.
    said = "the optimiser stopped .* sd from a mode|no curvature at its mode"
    with pytest.raises(SolverError, match=said):
        cal.sample(model, truth, sampler="laplace")


@dataclass(frozen=True, eq=False)
class Even(LinearForward):
    """Only the square of mu's distance from 75 kPa is seen, ``slope`` sd higher on one side."""

    slope: float = 0.0

    def __call__(self, theta):
        x = (theta[0] - 75.0) / 5.0
        y = (theta[1] - 75.0) / 5.0
        return jnp.ones((len(self.nodes), 3)) * jnp.array([x**2 - 1.0, self.slope * x, y])


@pytest.mark.parametrize(("slope", "told"), [(0.0, True), (0.02, True), (0.5, False)])
def test_a_second_mode_nearly_as_high_is_told(beam, slope, told):
    """At x = -1 the log density is (2 slope / 0.1)^2 / 2 below that at x = 1: 0.08 and 50 nats."""
    forward = linear_forward(beam, of=Even, slope=slope)
    prior = {name: dist.Normal(75.0, 10.0) for name in beam.parameter_names}
    observe = cal.nodal_displacements(beam, [3])
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.1), prior, check_scale=False)
    data = np.array([[0.0, slope, 0.0]])
    posterior = cal.sample(model, data, sampler="laplace", options=LaplaceOptions(draws=500))
    found = [line for line in posterior.warnings() if "another mode" in line]
    assert bool(found) is told
    if told:
        lower = posterior.tree.attrs["missed_mode_nats"]
        assert lower == pytest.approx((2.0 * slope / 0.1) ** 2 / 2.0, abs=0.5)
        assert posterior.tree.attrs["missed_mode"] in ("lam 75, mu 70", "lam 75, mu 80")
