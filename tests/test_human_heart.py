"""The study of a heart's frames: its scenes, and its bands against one dense Gaussian."""

import numpy as np
import pytest
from studies.human_heart.__main__ import prior_of
from studies.human_heart.bands import _at, _field
from studies.human_heart.heart import (
    AS_IMAGED,
    CONTRACTING,
    FRAMES,
    OTHERS,
    SYSTOLE,
    _scene_file,
    scene_of,
)

import emulator as em
from emulator.geometry.generators.biventricle import biventricle
from emulator.geometry.io import write_mesh

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


ALL = {"a", "a_f", "pressure", "right_pressure", "pericardium", "annulus", "imaged", "imaged_right"}


@pytest.mark.parametrize(
    ("assumed", "without", "more"),
    [
        (AS_IMAGED, set(), set()),
        (OTHERS[0], {"imaged", "imaged_right"}, set()),
        (OTHERS[1], {"annulus"}, set()),
        (OTHERS[2], {"right_pressure", "imaged_right"}, set()),
        (CONTRACTING, set(), {"tension"}),
    ],
)
def test_scenes_have_what_they_assume(assumed, without, more, tmp_path):
    mesh = (
        biventricle(rings=6, around=16, layers=(1, 1))
        if assumed.both
        else em.generators.human_ventricle(rings=4, around=12, layers=1)
    )
    write_mesh(tmp_path / "heart.vtu", mesh)
    (tmp_path / "heart.toml").write_text(_scene_file(assumed, [0.0, 0.0, 1.0]))
    scene = scene_of(tmp_path / "no data is read", tmp_path, assumed)
    assert set(scene.parameter_names) == ALL - without | more
    assert set(scene.loaded_by) == (
        {"pressure", "right_pressure", "tension"} & (ALL - without | more)
        if assumed.loaded
        else set()
    )
    frames = (SYSTOLE,) if assumed.contracts else FRAMES
    prior = prior_of(scene, frames, {"a": {"mean": 3.0, "sd": 0.5}, "b": {"mean": 1.0, "sd": 1.0}})
    pressures = {name for name in scene.parameter_names if "pressure" in name}
    expected = {f"{name}@{frame}" for name in pressures for frame in frames}
    assert set(prior) == expected | {"a"} | (
        set(scene.parameter_names) & {"imaged", "imaged_right"}
    )
