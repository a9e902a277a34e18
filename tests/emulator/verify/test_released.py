import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.verify import Benchmark, verify_published


def test_rows_pass_inside_their_tolerance_and_never_on_nan():
    assert Benchmark("a", 1.05, 1.0, 0.1, "").passed
    assert not Benchmark("a", 1.2, 1.0, 0.1, "").passed
    assert not Benchmark("a", float("nan"), 1.0, 0.1, "").passed
    assert Benchmark("a", 1.0, 1.0, 0.1, "s").to_json()["passed"]


@pytest.mark.slow  # the fast suite compares the two beams, below
@pytest.mark.parametrize("most", [12, None])
def test_fem_reproduces_the_released_solutions(published, most):
    rows = {row.name.split(",")[0]: row for row in verify_published(published, most=most)}
    assert len(rows) == 8
    for model in ("OnceClampedBeam", "TwistingBeam"):
        assert rows[f"{model}: relative displacement error"].measured <= 1e-8
        assert rows[f"{model}: relative energy error"].measured <= 1e-10
    for model in ("Liver", "LeftVentricle"):
        assert rows[f"{model}: relative energy error"].measured <= 1e-6
    assert all(row.passed for row in rows.values())


@pytest.mark.slow
def test_a_wrong_reference_is_noticed(published, tmp_path, monkeypatch):
    import shutil

    monkeypatch.setattr("emulator.verify.released.MODELS", ("OnceClampedBeam", "TwistingBeam"))
    for model in ("OnceClampedBeam", "TwistingBeam"):
        shutil.copytree(published / model, tmp_path / model)
    path = tmp_path / "TwistingBeam/simulationData/test/displacement.npy"
    field = np.load(path)
    path.chmod(0o644)
    np.save(path, field * (1 + 1e-6))
    failed = [row.name for row in verify_published(tmp_path, most=5) if not row.passed]
    assert any("TwistingBeam: relative displacement error" in name for name in failed)
    assert not any("OnceClampedBeam" in name for name in failed)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="folder .*nowhere does not exist"):
        verify_published(tmp_path / "nowhere")
