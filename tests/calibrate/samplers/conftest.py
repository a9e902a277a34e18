"""A posterior of two modes."""

import numpy as np
import numpyro.distributions as dist
import pytest

import calibrate as cal
from linear_support import Even, linear_forward


@pytest.fixture(scope="module")
def two_modes(beam):
    """Modes at mu = 65 and 85, each 0.3 wide; the prior favours the lower one."""
    forward = linear_forward(beam, of=Even)
    prior = {"mu": dist.Normal(73.0, 9.0), "lam": dist.Normal(75.0, 8.0)}
    observe = cal.nodal_displacements(beam, [3])
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.1), prior, check_scale=False)
    return model, np.ones((1, 3))
