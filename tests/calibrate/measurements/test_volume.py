"""A cavity's volume over the range of its pressure."""

import numpy as np

from calibrate.measurements.volume import CavityVolume, pressure_volume
from linear_support import linear_forward


def test_each_volume_is_that_of_the_cavity_at_its_pressure(ventricle):
    forward = linear_forward(ventricle)
    curve = pressure_volume(forward)
    column = ventricle.parameter_names.index("pressure")
    pressure = ventricle.parameters[column]
    assert (curve.pressures[0], curve.pressures[-1]) == (pressure.low, pressure.high)
    volume, theta = CavityVolume(ventricle), ventricle.centre
    expected = [
        volume(forward(theta.at[column].set(p))[volume.nodes], theta) for p in curve.pressures
    ]
    assert np.ptp(expected) > 0.0
    np.testing.assert_allclose(curve.volumes(theta), expected, rtol=1e-12)
    # The pressure in theta is replaced.
    other = theta.at[column].set(pressure.high)
    np.testing.assert_allclose(curve.volumes(other), expected, rtol=1e-12)


def test_a_body_without_a_cavity_has_no_curve(beam):
    assert pressure_volume(linear_forward(beam)) is None
