"""Load states in files: known parameters, loading curves, a file for each state."""

import numpy as np
import pytest
import xarray as xr

from calibrate.measurements.data import read_measurements
from emulator.core.errors import InputError

CURVE = "known:lam,parameter:mu\n60,70\n62,71\n64,\n66,73\n"


def known_in(scene, files):
    return read_measurements(scene, files)[2]


def write(folder, **files):
    for name, text in files.items():
        (folder / f"{name}.csv").write_text(text)
    return {name: str(folder / f"{name}.csv") for name in files}


def test_rows_of_a_loading_curve_are_load_states(beam, tmp_path):
    path = write(tmp_path, curve=CURVE.replace("64,\n", ""))["curve"]
    observe, data = read_measurements(beam, path)[:2]
    assert list(observe.parts) == ["parameter:mu@1", "parameter:mu@2", "parameter:mu@3"]
    assert [float(v) for v in data.values()] == [70.0, 71.0, 73.0]
    assert known_in(beam, path) == {"lam@1": 60.0, "lam@2": 62.0, "lam@3": 66.0}
    # One observation in all states is one object: its states are one program.
    assert len({id(part) for part in observe.parts.values()}) == 1


def test_a_file_for_each_state_and_a_curve_of_its_own_states(beam, tmp_path):
    files = write(
        tmp_path,
        rest="node,ux,uy,uz,known:lam\n3,0,0,1,61\n",
        pull="known:lam,parameter:mu\n60,70\n62,71\n",
    )
    observe, data = read_measurements(beam, files)[:2]
    assert list(data) == ["displacement@rest", "parameter:mu@pull.1", "parameter:mu@pull.2"]
    assert observe.states == ("rest", "pull.1", "pull.2")
    assert known_in(beam, files) == {"lam@rest": 61.0, "lam@pull.1": 60.0, "lam@pull.2": 62.0}


def test_a_state_knows_one_value(beam, tmp_path):
    text = "state,known:lam,parameter:mu\na,60,70\na,61,\nb,62,72\n"
    path = write(tmp_path, d=text)["d"]
    with pytest.raises(InputError, match="row 2, column 'known:lam' is 61.0, and 60.0 before it"):
        known_in(beam, path)
    path = write(tmp_path, d=text.replace("a,61,", "a,,"))["d"]
    assert known_in(beam, path) == {"lam@a": 60.0, "lam@b": 62.0}
    path = write(tmp_path, d=text.replace("61", "much"))["d"]
    with pytest.raises(InputError, match="column 'known:lam' is 'much', not a number"):
        known_in(beam, path)


def test_known_in_netcdf(beam, tmp_path):
    data = {"parameter:mu@a": 70.0, "known:lam@a": 60.0, "parameter:mu@b": 71.0}
    xr.Dataset(data).to_netcdf(tmp_path / "d.nc", engine="h5netcdf")
    assert known_in(beam, tmp_path / "d.nc") == {"lam@a": 60.0}
    assert list(read_measurements(beam, tmp_path / "d.nc")[1]) == [
        "parameter:mu@a",
        "parameter:mu@b",
    ]


def test_names_of_states_and_files_that_cannot_be(beam, tmp_path):
    files = write(tmp_path, d=CURVE)
    with pytest.raises(InputError, match="data: load state 'a@b'; give it a name without @, / and"):
        read_measurements(beam, {"a@b": files["d"]})
    with pytest.raises(InputError, match="none.csv does not exist"):
        read_measurements(beam, {"a": str(tmp_path / "none.csv")})


def test_states_together_are_states_one_by_one(beam, tmp_path):
    """What is the same in several states is evaluated at once, to the same numbers."""
    text = "state,node,ux,uy,uz,parameter:mu\n"
    text += "".join(f"{s},{n},0,0,1,\n" for s in "abc" for n in (3, 11)) + "b,,,,,70\n"
    observe, _ = read_measurements(beam, write(tmp_path, d=text)["d"])[:2]
    rng = np.random.default_rng(0)
    u = rng.normal(size=(2, 3, len(observe.nodes), 3))
    thetas = rng.normal(size=(2, 3, 2))
    found = observe(u, thetas)
    assert list(found) == list(observe.parts)
    for name, part in observe.parts.items():
        s = "abc".index(name[-1])
        rows = [list(observe.nodes).index(n) for n in part.nodes]
        np.testing.assert_array_equal(found[name], part(u[:, s, rows], thetas[:, s]))
