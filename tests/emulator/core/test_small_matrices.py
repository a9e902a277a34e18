"""Elimination against NumPy's inverse and determinant."""

import jax.numpy as jnp
import numpy as np
import pytest

from emulator.core.gaussian_process import eliminated


def test_elimination_is_the_inverse_and_the_determinant():
    rng = np.random.default_rng(1)
    half, rows = rng.normal(size=(7, 7)), rng.normal(size=(7, 3))
    M = half @ half.T + np.eye(7)
    pivots, reduced = eliminated(jnp.asarray(M), jnp.asarray(rows))
    assert float(jnp.prod(pivots)) == pytest.approx(np.linalg.det(M))
    found = (reduced.T / pivots) @ reduced
    np.testing.assert_allclose(found, rows.T @ np.linalg.solve(M, rows), atol=1e-10)
