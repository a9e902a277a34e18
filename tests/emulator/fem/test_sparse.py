import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.fem.sparse import block_pattern


@pytest.fixture(scope="module")
def pattern():
    """Two blocks of four unknowns that share two; one of the seven is held."""
    dofs = np.array([[0, 1, 2, 3], [2, 3, 4, 5]])
    free = np.array([0, 1, 2, 3, -1, 4])
    return block_pattern([dofs], free, symmetric=False)


def dense(pattern, values):
    A = np.zeros((pattern.size, pattern.size))
    A[pattern.rows, pattern.columns] = values
    return A


def test_positive_definite_is_what_the_eigenvalues_say(pattern):
    rng = np.random.default_rng(0)
    asked = jax.jit(pattern.positive_definite)
    seen = set()
    for shift in np.linspace(-1.0, 8.0, 25):
        A = rng.normal(size=(pattern.size,) * 2)
        A = dense(pattern, (A + A.T)[pattern.rows, pattern.columns]) + shift * np.eye(pattern.size)
        definite = bool(np.linalg.eigvalsh(A).min() > 0.0)
        seen.add(definite)
        assert bool(asked(jnp.asarray(A[pattern.rows, pattern.columns]))) is definite
    assert seen == {True, False}


def test_zero_pivots_are_not_positive_definite_and_a_batch_is_asked_one_by_one(pattern):
    swap = dense(pattern, 0.0 * pattern.rows)
    swap[0, 1] = swap[1, 0] = 1.0  # pivots only off the diagonal: eigenvalues 1 and -1
    swap[2:, 2:] += np.eye(pattern.size - 2)
    both = np.stack([swap, np.eye(pattern.size), -np.eye(pattern.size), 0.0 * swap])
    values = jnp.asarray(both[:, pattern.rows, pattern.columns])
    found = jax.jit(jax.vmap(pattern.positive_definite))(values)
    np.testing.assert_array_equal(found, [False, True, False, False])
