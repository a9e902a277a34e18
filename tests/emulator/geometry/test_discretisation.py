"""Integrals over a body."""

import numpy as np

from emulator.geometry.discretisation import discretise
from emulator.geometry.generators.box import box
from emulator.geometry.refinement import to_quadratic


def test_the_laplacian_is_the_integral_of_squared_gradients():
    """Of u = x^2 + y z in a box: 4 x^2 + y^2 + z^2, integrated by hand."""
    a, b, c = 2.0, 1.0, 3.0
    mesh = to_quadratic(box((a, b, c), (2, 1, 2)))
    x, y, z = mesh.nodes.T
    u = x**2 + y * z
    by_hand = a * b * c * (4.0 * a**2 + b**2 + c**2) / 3.0
    L = discretise(mesh).laplacian()
    np.testing.assert_allclose(u @ (L @ u), by_hand, rtol=1e-12)
    np.testing.assert_allclose(L @ np.ones(len(u)), 0.0, atol=1e-12)
