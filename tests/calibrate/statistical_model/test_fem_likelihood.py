import numpy as np

import calibrate as cal
from calibrate.statistical_model import FEMLikelihood
from linear_support import linear_forward


def test_what_fem_says_at_a_draw(beam, simulator):
    """Against FEM and the normal density by hand."""
    observe = cal.nodal_displacements(beam, [3, 11])
    model = cal.model(linear_forward(beam), observe, cal.GaussianNoise(sd=0.2))
    draw = {"mu": 70.0, "lam": 80.0}
    u = np.asarray(simulator(beam.theta(**draw)))
    data = {"displacement": u[[3, 11]] + 0.1}
    found = FEMLikelihood(model, simulator)(draw, data, stability=True)
    by_hand = -0.5 * 6 * (0.1 / 0.2) ** 2 - 6 * np.log(0.2 * np.sqrt(2.0 * np.pi))
    np.testing.assert_allclose(found.fem, by_hand, rtol=1e-6)
    np.testing.assert_allclose(found.means["displacement"], u[[3, 11]], atol=1e-6)
    assert found.converged
    assert found.stable
    assert 0.5 < found.smallest_J < 1.0
    assert found.cheap < found.fem
    assert FEMLikelihood(model, simulator)(draw, data).stable is None


def test_slopes_of_the_means_are_those_of_differences(beam, simulator):
    observe = cal.nodal_displacements(beam, [3, 11])
    model = cal.model(linear_forward(beam), observe, cal.GaussianNoise(sd=0.2))
    data = {"displacement": np.zeros((2, 3))}
    fem = FEMLikelihood(model, simulator)

    def told(mu, lam):
        return next(fem.many([{"mu": mu, "lam": lam}], data, slopes=True))[1]

    slopes = told(70.0, 80.0).slopes
    assert slopes.shape == (6, 1, 2)
    for k, step in enumerate(((0.1, 0.0), (0.0, 0.1))):
        ahead, behind = (
            np.asarray(told(70.0 + sign * step[0], 80.0 + sign * step[1]).means["displacement"])
            for sign in (1.0, -1.0)
        )
        difference = (ahead - behind).ravel() / 0.2
        np.testing.assert_allclose(slopes[:, 0, k], difference, rtol=1e-4, atol=1e-7)
    assert fem({"mu": 70.0, "lam": 80.0}, data).slopes is None
