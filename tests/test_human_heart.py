"""The bands of the study of a heart's frames: against one dense Gaussian, and by hand."""

import numpy as np
import pytest
from studies.human_heart.bands import _at, _field

H, NEW = np.array([-0.4, 0.3, 1.9]), np.array([-0.5, 1.1])


def kernel(count):
    x = np.linspace(0.0, 3.0, count)
    return np.exp(-0.5 * (x[:, None] - x) ** 2)


def test_the_field_is_that_of_one_dense_gaussian():
    K = kernel(5)
    rng = np.random.default_rng(0)
    missed = rng.normal(size=(3, 5)) + np.outer(H, np.arange(5.0))
    mean, sd, sds = _field(missed, K, H, NEW)
    grows, frame, own = (value**2 for value in sds.values())
    shared = grows * np.outer(H, H) + frame * (np.ones((3, 3)) + np.eye(3))
    C = np.kron(shared, K) + own * np.eye(15)
    for v, h in enumerate(NEW):
        across = np.kron(grows * h * H + frame, K)  # (5, 15)
        before = (grows * h**2 + 2.0 * frame) * K
        np.testing.assert_allclose(mean[v], across @ np.linalg.solve(C, missed.ravel()), atol=1e-8)
        after = before - across @ np.linalg.solve(C, across.T)
        np.testing.assert_allclose(sd[v] ** 2, np.diag(after) + own, rtol=1e-7)


def test_what_grows_with_the_volume_is_found():
    rng, K = np.random.default_rng(1), kernel(40)
    root = np.linalg.cholesky(K + 1e-10 * np.eye(40))
    slope = 2.0 * root @ rng.normal(size=40)
    missed = np.outer(H, slope) + 0.1 * rng.normal(size=(3, 40)) @ root.T
    mean, sd, sds = _field(missed, K, H, NEW)
    assert sds["grows"] > 5.0 * sds["frame"]
    assert np.mean(np.abs(mean[1] - NEW[1] * slope) < 3.0 * sd[1]) > 0.9


def test_a_value_is_taken_where_the_volume_is_reached():
    left = np.array([[100.0, 100.0], [140.0, 120.0], [160.0, 180.0]])
    value = np.array([[0.0, 0.0], [4.0, 2.0], [5.0, 8.0]])
    assert _at(150.0, left, value) == pytest.approx([4.5, 5.0])
