"""A kept result is certified only with the run and the forward map it was sampled with."""

import errno
import json
import shutil
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

import emulator as em
from calibrate.cli import main
from calibrate.posterior import read_tree
from calibrate.project import Run, infer, read_posterior
from emulator.core.errors import InputError
from emulator.core.store import exclusive, read_arrays, save_arrays
from emulator.scenes.built_in import BUILT_IN

SCENE = "once_clamped_beam"
RUN = Run(
    SCENE,
    truth={"mu": 73.0, "lam": 61.0},
    observe="nodes:4",
    forward="reduced",
    forward_options={"fem_runs": 6},
    warmup=40,
    draws=40,
    chains=2,
)


@pytest.fixture(scope="module")
def infer_once(tmp_path_factory):
    """A result with a reduced model, on a coarse beam under the built-in one's name."""
    scene = em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BUILT_IN, SCENE, lambda **_: scene)
        folder = tmp_path_factory.mktemp("result")
        yield folder, infer(RUN, folder)


@pytest.fixture
def folder(infer_once, tmp_path):
    """A copy of the result, to be spoiled."""
    shutil.copytree(infer_once[0], tmp_path / "r")
    return tmp_path / "r"


def edit(folder, **entries):
    run = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**run, **entries}))


def refusal(folder, capsys):
    """The one line with which ``certify`` refuses, having written nothing."""
    assert main(["certify", str(folder), "--draws", "25"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert not (folder / "certificate.json").exists()
    return said


def test_certify_restores_the_map_and_runs_no_campaign(infer_once, folder, monkeypatch, capsys):
    solve, solved = em.Simulator.solve, []
    monkeypatch.setattr(
        em.Simulator, "solve", lambda self, *a, **k: (solved.append(0), solve(self, *a, **k))[1]
    )
    assert main(["certify", str(folder), "--draws", "25", "--no-mesh", "--json"]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["certificate"]["failed"] == 0
    assert 18 <= len(solved) <= 25  # a point drawn twice is solved once; a campaign: six more
    before, (run, after) = infer_once[1], read_posterior(folder)
    assert run == RUN.named(after.model.observe)  # noise by name, defaults filled in
    assert after.model.full.fingerprint == before.model.full.fingerprint
    theta = after.model.full.scene.centre
    np.testing.assert_array_equal(after.model.full(theta), before.model.full(theta))
    attributes = read_tree(folder / "posterior.nc").attrs
    assert attributes["forward_fingerprint"] == before.model.full.fingerprint


def test_another_map_is_refused(folder, capsys):
    path = folder / "forward.safetensors"
    arrays, metadata = read_arrays(path)
    save_arrays(path, {**arrays, "mean": arrays["mean"] + 1e-6}, metadata)
    assert "was made with another reduced map" in refusal(folder, capsys)
    # So is one whose arrays do not even fit together.
    save_arrays(path, {**arrays, "modes": np.zeros((1, 2, 3))}, metadata)
    assert "was made with another reduced map" in refusal(folder, capsys)


def test_a_spoiled_map_is_refused(folder, capsys):
    path = folder / "forward.safetensors"
    path.write_bytes(path.read_bytes()[:300])
    assert "forward.safetensors is truncated" in refusal(folder, capsys)
    path.unlink()
    assert "forward.safetensors, the reduced map of the posterior" in refusal(folder, capsys)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"seed": 3}, "sampled with seed = 0, but run.json says 3"),
        ({"warmup": 41}, "sampled with warmup = 40, but run.json says 41"),
        ({"truth": {"mu": 80.0, "lam": 61.0}}, "sampled with truth = {"),
        ({"forward": "fem", "forward_options": {}}, 'sampled with forward = "reduced"'),
        ({"forward_options": {"fem_runs": 7}}, 'sampled with forward_options = {"fem_runs": 6}'),
        ({"forward_options": {"steps": 7}}, "--steps has no effect without --forward corrected"),
        ({"forward": "spline"}, "forward map 'spline' is unknown"),
    ],
)
def test_an_edited_run_is_refused_by_the_name_of_its_entry(folder, capsys, entries, message):
    edit(folder, **entries)
    assert message in refusal(folder, capsys)


def test_an_edited_noise_is_refused(folder, capsys):
    name = next(n for n in json.loads((folder / "run.json").read_text()) if n.startswith("noise"))
    edit(folder, **{name: 2.0})
    assert f"sampled with {name} = " in refusal(folder, capsys)


def test_a_moved_scene_is_not_an_edited_run(folder):
    edit(folder, root="/elsewhere")
    assert read_posterior(folder)[0].root == "/elsewhere"


def test_a_run_of_an_earlier_version_is_read_unless_it_learned_an_error(folder, capsys):
    tree = read_tree(folder / "posterior.nc")
    entries = {"error_runs": 0, "mesh_error_runs": 0}
    tree.attrs["run"] = json.dumps(json.loads(tree.attrs["run"]) | entries)
    tree.to_netcdf(folder / "posterior.nc", engine="h5netcdf")
    edit(folder, **entries)
    assert read_posterior(folder)[0].seed == RUN.seed
    for name in entries:
        edit(folder, **entries | {name: 24})
        said = refusal(folder, capsys)
        assert f"run.json: {name} is 24, but errors are no longer learned; infer again" in said
        assert "--forward rounds" in said
        assert "finer:SCENE" in said


def test_a_posterior_that_names_no_run_is_refused(infer_once, folder):
    tree = read_tree(folder / "posterior.nc")
    del tree.attrs["run"]
    tree.to_netcdf(folder / "posterior.nc", engine="h5netcdf")
    with pytest.raises(InputError, match="does not name the run it was sampled for"):
        read_posterior(folder)


def test_a_result_is_replaced_at_once_or_not_at_all(infer_once, folder, monkeypatch):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    (folder / "certificate.json").touch()
    (folder / "error.safetensors").touch()
    monkeypatch.setattr("calibrate.project.calibration.sample", lambda *_, **__: infer_once[1])
    with monkeypatch.context() as patch:
        full = OSError(errno.ENOSPC, "No space left on device")
        patch.setattr("emulator.core.store.os.fsync", Mock(side_effect=[None, full]))
        with pytest.raises(
            OSError, match="No space left on device; make room and repeat.*run.json'"
        ):
            infer(RUN, folder, force=True)
    there = {path.name for path in folder.iterdir()}
    assert there == {*before, "certificate.json", "error.safetensors"}
    assert all((folder / name).read_bytes() == content for name, content in before.items())
    infer(RUN, folder, force=True)
    # Nothing stays of the earlier one that the new one does not have.
    assert {path.name for path in folder.iterdir()} == set(before)
    read_posterior(folder)


def test_a_full_disk_is_told_before_the_draws_are_made(tmp_path, monkeypatch):
    monkeypatch.setattr("calibrate.samplers.disk_usage", lambda _: Mock(free=1000))
    with pytest.raises(InputError, match=r"the draws take 0.0166 MB, and the disk has 0.001 free"):
        infer(RUN, tmp_path / "r")
    assert not (tmp_path / "r").exists()


def test_results_that_are_there_are_not_replaced(folder):
    before = (folder / "posterior.nc").stat().st_mtime_ns
    with pytest.raises(InputError, match=r"earlier run \(posterior.nc, .*\); .* --force"):
        infer(RUN, folder)
    assert (folder / "posterior.nc").stat().st_mtime_ns == before


def test_two_runs_do_not_share_a_folder(folder):
    with (
        exclusive(folder / "run.json", "run"),
        pytest.raises(InputError, match="another run is writing to it; wait until it ends"),
    ):
        infer(RUN, folder, force=True)
    assert not list(folder.glob("*.lock"))


def test_data_that_were_edited_after_the_run(folder, capsys):
    """Certificate and report would be of other numbers than the folder shows."""
    path = folder / "data.csv"
    before = path.read_bytes()
    path.write_bytes(before.replace(b"1", b"2", 1))
    assert "data.csv was edited after" in refusal(folder, capsys)
    assert main(["report", str(folder), "--no-fem"]) == 2
    assert "infer again with the new data" in capsys.readouterr().err
    path.write_bytes(before)
    tree = read_tree(folder / "posterior.nc")
    del tree.attrs["data_sha256"]
    tree.to_netcdf(folder / "posterior.nc", engine="h5netcdf")
    path.write_bytes(before.replace(b"1", b"2", 1))
    read_posterior(folder)  # a run of an earlier version


@pytest.mark.slow
def test_a_reweighted_posterior_is_kept_and_certified_like_any_other(infer_once, tmp_path, capsys):
    source, target = tmp_path / "s", tmp_path / "t"
    infer(replace(RUN, draws=250), source)
    # A linear block of eight elements: its mesh is not what is asked about.
    own = ["--mesh-runs", "0", "--json"]
    words = ["certify", str(source), "--draws", "80", "--reweight", str(target), *own]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "accepted"
    names = {path.name for path in target.iterdir()}
    assert names == {"run.json", "data.csv", "forward.safetensors", "posterior.nc"}
    _run, posterior = read_posterior(target)
    assert "reweighted" in posterior.tree.attrs
    before = read_posterior(source)[1].summary()
    for name, row in posterior.summary().items():
        assert abs(row["mean"] - before[name]["mean"]) < 0.3 * row["sd"]
    assert main(["certify", str(target), "--draws", "40", *own]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["verdict"] in ("accepted", "undecided")


def test_a_posterior_is_not_reweighted_onto_itself(folder, capsys):
    assert main(["certify", str(folder), "--draws", "25", "--reweight", str(folder)]) == 2
    assert "--reweight" in capsys.readouterr().err
    assert (folder / "posterior.nc").exists()
