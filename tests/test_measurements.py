"""Real measurements: that what a study reads is what was recorded."""

import csv
from dataclasses import dataclass, replace

import numpy as np
import pytest
from studies.common.output import Results
from studies.sheep_myocardium.curves import Runs
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


def test_what_was_kept_apart_is_judged(measured, tmp_path, monkeypatch, capsys):
    """Recordings of 0.51 N in place of those of 1.00 N: far above what was predicted."""
    from studies.silicone_beam.__main__ import HERE, SEED, judge, main

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
    words = ["silicone_beam", "--judge", str(tmp_path), "--out", str(tmp_path / "out")]
    monkeypatch.setattr("sys.argv", words)
    main()
    heading, *rows = capsys.readouterr().out.splitlines()[1:]
    assert heading.split() == ["prediction", "inside", "90", "%", "bands", "along", "across", "up"]
    assert rows[0].startswith("rig where it was")
    assert " of 9 " in rows[0]


@dataclass(frozen=True)
class Formula:
    """A cube whose forces are a formula; ``solved`` counts its runs by mode."""

    number: int
    curves: list
    solved: list
    factor: float = 1.0

    @property
    def amounts(self):
        return np.stack([curve.amount for curve in self.curves])

    def runs(self, x, modes=range(3)):
        self.solved.extend([*modes] * len(x))
        stiff = self.factor * np.exp(x.sum(axis=1))[:, None]
        return Runs(x, np.concatenate([stiff * self.amounts[m] for m in modes], axis=1), None)


def test_hearts_kept_apart_are_judged_by_as_few_runs_as_decide(measured, monkeypatch):
    """A heart of the study in place of one that was kept apart; bands by all draws at once."""
    from studies.sheep_myocardium import __main__ as study

    one = study.heart(measured / "ovine_myocardium" / "TSL1")
    for k, curve in enumerate(one.curves.values()):  # half of the modes are far from the bands
        curve.force[:] = (5.0 if k % 2 else 0.4) * curve.amount
    solved = []
    bodies = [Formula(k, one.of_cube(k), solved) for k in range(3)]
    monkeypatch.setattr(study, "cubes", lambda *_, **__: bodies)
    monkeypatch.setattr(study, "finer", lambda body: replace(body, factor=1.1, solved=[]))
    rng = np.random.default_rng(0)
    draws = np.exp(rng.normal(np.log([0.5, 8, 0.8, 8, 0.8, 8, 0.3, 8, 0.2]), 0.2, (48, 9)))
    found = study._judged(one, draws, np.random.default_rng(1))

    rng, omega = np.random.default_rng(1), np.repeat(draws[:, -1], 32)
    for body in bodies:
        x = np.asarray([study.population.positions(np.log(row[:-1])) for row in draws])
        turned = np.clip(rng.normal(0.0, study.ANGLE_SD, (48, 2)), -1.0, 1.0)
        x = np.concatenate([x, turned], axis=1)
        coarse, fine = body.runs(x).force, replace(body, factor=1.1).runs(x).force
        forces = coarse * study.without_mesh(coarse[:2], fine[:2])
        for mean, curve in zip(np.split(forces, 3, axis=1), body.curves, strict=True):
            many = np.repeat(mean, 32, axis=0)
            z = rng.normal(size=many.shape)
            made = study.replicated(curve.amount, many, omega, z)
            low, high = np.quantile(made, (0.05, 0.95), axis=0)
            wanted = int(((low <= curve.force) & (curve.force <= high)).sum())
            assert found["by_mode"][curve.mode] == wanted, curve.mode
    assert 0 < found["inside"] < found["points"] == 90
    assert len(solved) - 2 * 3 * 3 * 48 < 0.75 * 3 * 3 * 48
    _, row = study._told({"TSL1": found, "name": "judged", "status": "done"}).splitlines()
    assert row.split() == [
        "TSL1",
        str(found["inside"]),
        "of",
        "90",
        *map(str, found["by_mode"].values()),
    ]
