"""Real measurements: that what a study reads is what was recorded."""

import csv

import numpy as np
import pytest
from studies.common.output import Results
from studies.silicone_beam import beam, experiment

import calibrate as cal
from calibrate.model_error.kinds import rotation_of
from emulator.core.errors import InputError
from scene_support import rotation


def test_recordings_are_read_as_others_read_them(measured):
    """Against a table of means that another program made of the same files."""
    folder = measured / "silicone_beam"
    with (folder / "markers.csv").open() as file:
        table = list(csv.DictReader(file))
    for name in {row["file"] for row in table}:
        found = experiment.read(folder / name)
        rows = {(r["state"], int(r["marker"])): r for r in table if r["file"] == name}
        for marker in range(3):
            for state, places in (("held", found.held), ("static", found.static)):
                x, y, z = (float(rows[state, marker][f"{axis}_mm"]) for axis in "xyz")
                np.testing.assert_allclose(places[marker], [z, -y, x], atol=1e-3)
            x, y, z = (float(rows["static", marker + 3][f"{axis}_mm"]) for axis in "xyz")
            np.testing.assert_allclose(found.clamp[marker], [z, -y, x], atol=1e-3)


def test_a_folder_without_recordings(tmp_path):
    with pytest.raises(InputError, match="has no beam_gravity_.* give --data DIR"):
        experiment.measured(tmp_path)


def made_up() -> experiment.Measured:
    rng = np.random.default_rng(0)
    moved = [0.1 * rng.normal(size=(3, 3)) for _ in range(3)]
    return experiment.Measured(experiment.TIP, *moved, shift=np.zeros(3), repeats=(0.0, 0.0))


def test_the_turn_of_markers_is_found():
    R = rotation(2)
    found = rotation_of(experiment.TIP, experiment.TIP @ R.T + 3.0 - experiment.TIP)
    np.testing.assert_allclose(found, R, atol=1e-12)


def test_what_is_unknown_fits_the_observations():
    seen = made_up()
    scene = beam.scene((2, 1, 1))
    tip = cal.rigid_markers(scene, "right", seen.rest)
    shapes = {beam.WEIGHT: tip.shape, beam.LOADED: tip.shape, beam.BASE: experiment.CLAMP.shape}
    for error in beam.unknowns(seen):
        for name, modes in error.modes.items():
            assert np.shape(modes) == (len(error.names), *shapes[name])
    # A pin that stands elsewhere changes what is seen by what the tip's turn makes of it.
    pins = next(e for e in beam.unknowns(seen) if e.names[0] == "pins x")
    turn = rotation_of(seen.rest, seen.weight) - np.eye(3)
    np.testing.assert_allclose(pins.modes[beam.WEIGHT][1, 2], beam.PIN * turn @ [0.0, 1.0, 0.0])


def test_what_was_kept_apart_is_judged(measured, tmp_path):
    """Recordings of 0.51 N in place of those of 1.00 N: far above what was predicted."""
    from studies.silicone_beam.__main__ import HERE, SEED, judge

    recording = measured / "silicone_beam" / "beam_load52_V2_a.c3d"
    (tmp_path / "beam_load102_a.c3d").write_bytes(recording.read_bytes())
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "results.json").write_bytes((HERE / "results.json").read_bytes())
    results = Results(tmp_path / "out", SEED, settings={"quick": False})
    found = judge(results, tmp_path)
    assert found["rig where it was"]["of"] == 9
    assert [row[2] for row in found["rig where it was"]["each"]] == [False, False, False]
    with pytest.raises(InputError, match="no recordings of another force"):
        judge(results, measured / "silicone_beam")
