import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.released.scenes import (
    models_in,
    published_scene,
    published_tests,
)


def test_the_built_in_beam_is_the_released_one(published):
    ours = em.scenes.once_clamped_beam(order=1)
    theirs = published_scene("OnceClampedBeam", published)
    np.testing.assert_allclose(ours.mesh.nodes, theirs.mesh.nodes, atol=1e-6)
    np.testing.assert_array_equal(ours.held, theirs.held)
    as_set = lambda scene: np.unique(np.sort(scene.mesh.elements, axis=1), axis=0)
    np.testing.assert_array_equal(as_set(ours), as_set(theirs))


def test_the_built_in_cube_is_twisted_like_the_released_one(published):
    ours = em.scenes.twisting_cube(edge=1.0, order=1)
    theirs = published_scene("TwistingBeam", published)
    np.testing.assert_allclose(ours.held_displacement, theirs.held_displacement, atol=1e-12)


def test_units(published):
    mesh = published_scene("OnceClampedBeam", published).mesh
    np.testing.assert_allclose(np.ptp(mesh.nodes, axis=0), [100.0, 10.0, 10.0])
    thetas, tests = published_tests("OnceClampedBeam", published)
    assert thetas.min() >= 50.0
    assert thetas.max() <= 100.0
    # 1 dyn cm = 1e-7 J = 0.1 microjoule = 0.1 mN mm
    raw = np.load(published / "OnceClampedBeam/simulationData/test/pe-values.npy")
    np.testing.assert_allclose(tests.energy, 0.1 * raw)


def test_missing_and_damaged_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"reference-coords.npy is missing"):
        published_scene("OnceClampedBeam", tmp_path)
    with pytest.raises(InputError, match="published model 'Heart' is unknown"):
        published_scene("Heart", tmp_path)
    geometry = tmp_path / "OnceClampedBeam" / "geometryData"
    geometry.mkdir(parents=True)
    np.save(geometry / "reference-coords.npy", np.eye(4, 3))
    np.save(geometry / "elements.npy", np.array([[0, 1, 2, 9]]))
    with pytest.raises(InputError, match="name nodes there are none of"):
        published_scene("OnceClampedBeam", tmp_path)
    np.save(geometry / "elements.npy", np.array([[0, 1, 2]]))
    with pytest.raises(InputError, match=r"has shape \(1, 3\); expected \('any', 4\)"):
        published_scene("OnceClampedBeam", tmp_path)
    np.save(geometry / "reference-coords.npy", np.full((4, 3), np.nan))
    with pytest.raises(InputError, match="has values that are not finite"):
        published_scene("OnceClampedBeam", tmp_path)
    folder = tmp_path / "OnceClampedBeam" / "simulationData" / "test"
    folder.mkdir(parents=True)
    (folder / "theta.npy").write_bytes(b"\x93NUMPY\x01\x00")
    with pytest.raises(InputError, match=r"theta.npy is not a readable .npy array"):
        published_tests("OnceClampedBeam", tmp_path)


@pytest.fixture
def twice_clamped(published, tmp_path):
    """A clone whose data folder holds a beam held at both ends, as the release has it."""
    folder = tmp_path / "data" / "TwiceClampedBeam" / "geometryData"
    folder.mkdir(parents=True)
    source = published / "OnceClampedBeam" / "geometryData"
    nodes = np.load(source / "reference-coords.npy")
    np.save(folder / "reference-coords.npy", nodes)
    np.save(folder / "elements.npy", np.load(source / "elements.npy"))
    x = nodes[:, 0]
    inner = (x > x.min() + 1e-6) & (x < x.max() - 1e-6)
    np.save(folder / "interior-points.npy", inner[:, None])
    return tmp_path


def test_the_twice_clamped_beam_is_read_from_a_clone(twice_clamped):
    assert models_in(twice_clamped) == ("TwiceClampedBeam",)
    scene = em.find_scene("published:TwiceClampedBeam", twice_clamped)
    assert scene.parameter_names == ("mu", "lam")
    ours = em.scenes.twice_clamped_beam(order=1)
    assert ours.identity.agrees(scene.identity)


def test_what_a_clone_lacks_is_named(twice_clamped):
    folder = twice_clamped / "data" / "TwiceClampedBeam"
    with pytest.raises(InputError, match=r"TwiceClampedBeam/simulationData/test/theta.npy is miss"):
        published_tests("TwiceClampedBeam", twice_clamped)
    (folder / "geometryData" / "elements.npy").write_text(
        "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 46208\n"
    )
    with pytest.raises(InputError, match=r"elements.npy is a pointer to a large file .* git lfs"):
        published_scene("TwiceClampedBeam", twice_clamped)
    (folder / "geometryData" / "elements.npy").unlink()
    with pytest.raises(InputError, match=r"elements.npy is missing; the clone lacks it"):
        published_scene("TwiceClampedBeam", twice_clamped)
