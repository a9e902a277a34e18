"""Campaigns: what is in the store, and that nothing is lost or solved twice."""

import signal
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
import zarr

import calibrate as cal
import emulator as em
from emulator.core.errors import InputError
from emulator.fem import sobol
from emulator.fem.campaign.store import ZarrRows, read_runs
from emulator.fem.solution import Status
from emulator.scenes.loads import Gravity
from scene_support import block


@pytest.fixture(scope="module")
def scene():
    return block(loads=(Gravity(density=150.0),), cells=(2, 1, 1))


@pytest.fixture
def solved(monkeypatch):
    """Theta of every solve."""
    seen, solve = [], em.Simulator.solve

    def watched(self, theta, start=None):
        seen.append(np.asarray(theta))
        return solve(self, theta, start)

    monkeypatch.setattr(em.Simulator, "solve", watched)
    return seen


def solved_rows(path):
    """Number of rows in a store, 0 where it is not there yet."""
    try:
        return int((zarr.open_group(path, mode="r")["status"][:] != -1).sum())
    except (OSError, ValueError, KeyError):
        return 0


def when(path, rows, act):
    """Do something once the store has so many rows, from a thread."""

    def watch():
        while solved_rows(path) < rows:
            time.sleep(0.01)
        act()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


def assert_whole(found, scene, count):
    """Every theta of the design once, and FEM's answer there."""
    assert (found["status"].values == Status.CONVERGED).all()
    thetas = sobol(scene, count, 0)
    np.testing.assert_array_equal(found["theta"], thetas)
    assert len(set(found["hash"].values.tolist())) == count
    expected = cal.campaign(scene, count)["displacement"]
    np.testing.assert_allclose(found["displacement"], expected, atol=1e-8)


def test_a_store_is_a_dataset(scene, tmp_path):
    made = cal.campaign(scene, 4, slopes=True, out=tmp_path / "runs.zarr")
    found = xr.open_zarr(tmp_path / "runs.zarr")
    nodes = len(scene.mesh.nodes)
    assert found.sizes == {"theta_id": 4, "parameter": 2, "node": nodes, "xyz": 3}
    assert found["displacement"].dims == ("theta_id", "node", "xyz")
    assert found["sensitivities"].dims == ("theta_id", "parameter", "node", "xyz")
    assert found["parameter"].values.tolist() == ["mu", "lam"]
    assert found["unit"].values.tolist() == ["kPa", "kPa"]
    assert found.attrs["fingerprint"] == scene.fingerprint
    assert found.attrs["design"] == {"design": "sobol", "seed": 0, "samples": 4}
    words = found["status"].attrs["flag_meanings"].split()
    assert words[found["status"].attrs["flag_values"].index(2)] == "load_limit"
    simulator, theta = em.Simulator(scene), sobol(scene, 4, 0)[2]
    np.testing.assert_allclose(found["displacement"][2], simulator(theta), atol=1e-8)
    energy = jax.jit(em.fem.potential_energy(scene))(simulator(theta), theta)
    np.testing.assert_allclose(found["energy"][2], energy, rtol=1e-8)
    slopes = simulator.sensitivities(simulator(theta), theta)
    np.testing.assert_allclose(found["sensitivities"][2], slopes, atol=1e-8)
    xr.testing.assert_equal(made, cal.campaign(scene, 4, slopes=True, out=tmp_path / "runs.zarr"))


def test_an_interrupted_campaign_goes_on(scene, tmp_path, monkeypatch, solved):
    path, write = tmp_path / "runs.zarr", ZarrRows.write

    def interrupted(self, row):
        if row.number == 3:  # its numbers are there already, its status is not
            self._arrays["displacement"][3] = 7.0
            raise KeyboardInterrupt
        write(self, row)

    monkeypatch.setattr(ZarrRows, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cal.campaign(scene, 6, out=path)
    assert solved_rows(path) == 3
    with pytest.raises(InputError, match="3 of 6 theta are not solved"):
        read_runs(path, scene)
    monkeypatch.setattr(ZarrRows, "write", write)
    solved.clear()
    found = cal.campaign(scene, 6, out=path)
    # Threads begin them in order, and may end in another one.
    again = sorted(np.asarray(theta).tolist() for theta in solved)
    assert again == sorted(np.asarray(sobol(scene, 6, 0)[3:]).tolist())
    assert_whole(found, scene, 6)
    assert [p.name for p in tmp_path.iterdir()] == ["runs.zarr"]


def test_a_solve_that_fails_is_a_row_and_not_learned_from(scene, tmp_path):
    thetas = sobol(scene, 3, 0).at[1, 0].set(jnp.nan)
    found = cal.campaign(scene, thetas=thetas, slopes=True, out=tmp_path / "runs.zarr")
    assert found["status"].values.tolist() == [0, Status.INVALID_INPUT, 0]
    for name in ("displacement", "sensitivities", "energy"):
        np.testing.assert_array_equal(np.isnan(found[name]).any(found[name].dims[1:]), [0, 1, 0])
    runs, digest = read_runs(tmp_path / "runs.zarr", scene)
    assert len(digest) == 16
    np.testing.assert_array_equal(runs.theta, thetas[::2])
    np.testing.assert_array_equal(runs.sensitivities, found["sensitivities"][::2])
    with pytest.raises(InputError, match="with another mesh, law, load or range"):
        read_runs(tmp_path / "runs.zarr", block())


@pytest.mark.slow
def test_one_process_writes_at_a_time(scene, tmp_path, monkeypatch):
    write = ZarrRows.write

    def meanwhile(self, row):
        with pytest.raises(InputError, match="another campaign is writing to it"):
            cal.campaign(scene, 2, out=tmp_path / "runs.zarr")
        write(self, row)

    monkeypatch.setattr(ZarrRows, "write", meanwhile)
    cal.campaign(scene, 2, out=tmp_path / "runs.zarr")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({}, "a number of samples or thetas"),
        ({"samples": 2, "design": "grid"}, "design 'grid' is unknown; known: sobol"),
        ({"thetas": np.ones((2, 3))}, r"shape \(2, 3\); expected \(count, 2\) for mu, lam"),
    ],
)
def test_bad_questions(scene, words, message):
    with pytest.raises(InputError, match=message):
        cal.campaign(scene, **words)


@pytest.mark.slow
def test_a_killed_process_loses_nothing(tmp_path):
    """Killed while it solves, a campaign goes on where it was."""
    path, count = tmp_path / "runs.zarr", 40
    words = ["campaign", "once_clamped_beam", "--samples", str(count), "--out", str(path)]
    command = [sys.executable, "-c", "import sys; from calibrate.cli import main; sys.exit(main())"]
    process = subprocess.Popen([*command, *words])
    when(path, 5, process.kill).join(timeout=300)
    assert process.wait() == -signal.SIGKILL
    before = xr.open_zarr(path).load()
    there = before["status"].values != -1
    assert 5 <= there.sum() < count
    subprocess.run([*command, *words], check=True)
    after = xr.open_zarr(path)
    scene = em.scenes.once_clamped_beam()
    assert_whole(after, scene, count)
    # What was there has not been solved again.
    for name in ("displacement", "seconds"):
        np.testing.assert_array_equal(after[name][there], before[name][there])
