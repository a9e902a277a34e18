"""Positive definite or not, asked of solves alone, against eigenvalues in closed form."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import coo_array, eye_array, kron

from emulator.fem.definiteness import inverse_is_positive
from emulator.fem.sparse import Pattern

SIDE = 20


@pytest.fixture(scope="module")
def laplacian():
    """Five-point Laplacian of a square with 400 unknowns, and its eigenvalues, mostly double."""
    n = SIDE
    line = eye_array(n, k=1) + eye_array(n, k=-1)
    one = 2.0 * eye_array(n) - line
    matrix = coo_array(kron(one, eye_array(n)) + kron(eye_array(n), one))
    single = 4.0 * np.sin(np.arange(1, n + 1) * np.pi / (2 * (n + 1))) ** 2
    return matrix, np.sort((single[:, None] + single).ravel())


@pytest.fixture(scope="module")
def asked(laplacian):
    """The question about the Laplacian less a shift, inside jit, with the factor of UMFPACK."""
    matrix, _ = laplacian
    rows, columns = (index.astype(np.int32) for index in matrix.coords)
    nothing = np.zeros(0, np.int32)
    pattern = Pattern(rows, columns, nothing, nothing, SIDE**2)

    @jax.jit
    def ask(shift):
        values = matrix.data - shift * (rows == columns)
        return inverse_is_positive(partial(pattern.solve, values, method="umfpack"), pattern.size)

    return ask


@pytest.mark.parametrize("below", [0, 1, 3, 10, 40, 200, 399, 400])
def test_a_shift_past_eigenvalues_is_noticed(laplacian, asked, below):
    """The second and third eigenvalue are equal: the sign of the determinant misses them."""
    ends = np.concatenate([[0.0], laplacian[1], [9.0]])
    for share in (0.01, 0.5, 0.99):
        shift = ends[below] + share * (ends[below + 1] - ends[below])
        assert bool(asked(shift)) is (below == 0), (below, share)


def test_a_small_matrix_is_what_its_eigenvalues_say():
    rng = np.random.default_rng(0)
    seen = set()
    ask = jax.jit(lambda inverse: inverse_is_positive(lambda b: inverse @ b, 5))
    for shift in np.linspace(-1.0, 8.0, 25):
        A = rng.normal(size=(5, 5))
        A = A + A.T + shift * np.eye(5)
        definite = bool(np.linalg.eigvalsh(A).min() > 0.0)
        seen.add(definite)
        assert bool(ask(jnp.asarray(np.linalg.inv(A)))) is definite
    assert seen == {True, False}


def test_few_distinct_eigenvalues_a_batch_and_what_is_no_number():
    inverses = [np.eye(30), -np.eye(30), np.diag([1.0, -1.0] * 15), np.full((30, 30), np.nan)]
    ask = jax.jit(jax.vmap(lambda inverse: inverse_is_positive(lambda b: inverse @ b, 30)))
    np.testing.assert_array_equal(ask(jnp.asarray(inverses)), [True, False, False, False])


@pytest.mark.parametrize("ratio", [1e-6, 1e-3, 1.0, 10.0])
def test_one_negative_eigenvalue_among_many_positive_ones(ratio):
    """Relative to the least positive one, and however large the others are."""
    eigenvalues = np.geomspace(1.0, 1e6, 500)
    eigenvalues[-1] = -ratio
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(500, 500)))[0]
    inverse = (rotation / eigenvalues) @ rotation.T
    assert not inverse_is_positive(lambda b: inverse @ b, 500)
    inverse = (rotation / np.abs(eigenvalues)) @ rotation.T
    assert inverse_is_positive(lambda b: inverse @ b, 500)
