"""Elimination against NumPy's inverse, determinant and solution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.core.small_matrices import eliminate, solve_modified


@pytest.mark.parametrize("size", [1, 3, 7])
def test_elimination_is_the_inverse_and_the_determinant(size):
    rng = np.random.default_rng(1)
    half, rows = rng.normal(size=(size, size)), rng.normal(size=(size, 3))
    M = half @ half.T + np.eye(size)
    for modify in (False, True):  # a positive definite matrix is not modified
        pivots, reduced = eliminate(jnp.asarray(M), jnp.asarray(rows), modify=modify)
        assert float(jnp.prod(pivots)) == pytest.approx(np.linalg.det(M))
        product = (reduced.T / pivots) @ reduced
        np.testing.assert_allclose(product, rows.T @ np.linalg.solve(M, rows), atol=1e-10)


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_solutions_of_definite_and_of_indefinite_matrices(size):
    """What is solved in place of an indefinite matrix is definite, by a larger diagonal only."""
    rng = np.random.default_rng(2)
    half, right = rng.normal(size=(20, size, size)), rng.normal(size=(20, size))
    definite = half @ np.swapaxes(half, 1, 2) + 0.1 * np.eye(size)
    solve = jax.jit(jax.vmap(solve_modified))
    expected = np.linalg.solve(definite, right[..., None])[..., 0]
    np.testing.assert_allclose(solve(definite, right), expected, rtol=1e-8)
    M = half + np.swapaxes(half, 1, 2)
    assert (np.linalg.eigvalsh(M)[:, 0] < 0.0).any()
    x = np.asarray(solve(M, right))
    added = (right - np.einsum("kij,kj->ki", M, x)) / x
    size_of = np.abs(M).max(axis=(1, 2))[:, None]
    assert (added > -1e-9 * size_of).all()
    modified = M + np.eye(size) * added[:, None]
    assert (np.linalg.eigvalsh(modified)[:, 0] > 0.0).all()
    np.testing.assert_allclose(added[np.linalg.eigvalsh(M)[:, 0] > 0.0], 0.0, atol=1e-9)


def test_pivots_that_are_not_positive():
    """Of 2 x 2 matrices by hand: each pivot's absolute value, or 1e-10 of the largest entry."""
    flat = solve_modified(jnp.diag(jnp.array([4.0, 0.0])), jnp.array([2.0, 1.0]))
    np.testing.assert_allclose(flat, [0.5, 1.0 / 4e-10])
    # [[-2, 1], [1, 1]]: -2 becomes 2, the rest 1 - 1/2; so [[2, 1], [1, 1]] x = [3, 2].
    bent = solve_modified(jnp.array([[-2.0, 1.0], [1.0, 1.0]]), jnp.array([3.0, 2.0]))
    np.testing.assert_allclose(bent, [1.0, 1.0])
