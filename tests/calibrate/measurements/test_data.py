import numpy as np
import pytest
import xarray as xr

import calibrate as cal
from calibrate.measurements import observations, spread_landmarks
from calibrate.measurements.data import read_measurements, write_data
from emulator.core.errors import InputError

VALUES = np.array([[0.1, 0.2, -3.0], [1.0, -2.0, 1e-7]])


def test_csv_round_trip(beam, tmp_path):
    for observe in (
        cal.nodal_displacements(beam, [7, 30]),
        cal.landmarks(beam, [[10.0, 5.0, 5.0], [60.0, 1.0, 2.0]]),
    ):
        write_data(tmp_path / "d.csv", observe, VALUES)
        back, values = read_measurements(beam, tmp_path / "d.csv")[:2]
        (name,) = values
        np.testing.assert_array_equal(values[name], VALUES)
        np.testing.assert_array_equal(back.parts[name].points, observe.points)
        assert type(back.parts[name]) is type(observe)


def test_netcdf(beam, tmp_path):
    data = xr.Dataset(
        {"displacement": (("point", "component"), VALUES)}, coords={"node": ("point", [7, 30])}
    )
    data.to_netcdf(tmp_path / "d.nc", engine="h5netcdf")
    observe, values = read_measurements(beam, tmp_path / "d.nc")[:2]
    np.testing.assert_array_equal(observe.nodes, [7, 30])
    np.testing.assert_array_equal(values["displacement"], VALUES)
    data.drop_vars("node").to_netcdf(tmp_path / "e.nc", engine="h5netcdf")
    with pytest.raises(
        InputError,
        match="variable 'node' is missing; expected variables node,displacement or position",
    ):
        read_measurements(beam, tmp_path / "e.nc")
    (tmp_path / "f.nc").write_bytes((tmp_path / "d.nc").read_bytes()[:200])
    with pytest.raises(InputError, match="neither CSV .* nor readable netCDF"):
        read_measurements(beam, tmp_path / "f.nc")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("node,ux,uy,uz\n3,0,0,inf\n", "row 1 has a displacement that is not finite"),
        ("node,ux,uy,uz\n3,,NA,nan\n", "every value of displacement is missing"),
        ("node,ux,uy,uz\n,0,0,1\n", "row 1, column 'node' is empty"),
        ("node,ux,uy,uz\nNA,0,0,1\n", "row 1, column 'node' is 'NA', not a number"),
        ("node,ux,uy,uz\n3,0,0,0\n400,0,0,0\n", "node 400 is unknown"),
        ("node,ux,uy,uz\n3,0,0,x\n", "row 1, column 'uz' is 'x', not a number"),
        ("node,ux,uy\n3,0,0\n", "column 'uz' is missing"),
        ("node,ux,uy,uz\n3.5,0,0,0\n", "nodes must be whole numbers"),
        ("x,y,z,ux,uy,uz\n500,0,0,0,0,0\n", "lies outside the body"),
        ("x,y,z,ux,uy,uz\n5,nan,0,0,0,0\n", "row 1 has a position that is not finite"),
        ("", "no data; expected columns node,ux,uy,uz or x,y,z,ux,uy,uz or .* or volume"),
    ],
)
def test_one_line_for_every_mistake(beam, tmp_path, text, message):
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_measurements(beam, tmp_path / "d.csv")
    assert "\n" not in str(caught.value)
    assert "d.csv" in str(caught.value)


LANDMARKS = np.array([[2.0, 3.0, 4.0], [-5.0, 0.5, 1e-7]])


@pytest.fixture
def points(ventricle):
    return spread_landmarks(ventricle, 2, seed=0)


def test_a_volume_beside_displacements_survives_a_csv_file(ventricle, points, tmp_path):
    several = {
        "displacement": cal.landmarks(ventricle, points),
        "volume": cal.CavityVolume(ventricle),
    }
    alone = {"volume": cal.CavityVolume(ventricle)}
    named = {"volume:endocardium": cal.CavityVolume(ventricle, "endocardium")}
    data = {"displacement": LANDMARKS, "volume": 123.4, "volume:endocardium": 99.5}
    for parts in (several, alone, named, {**several, **named}):
        given = {name: data[name] for name in parts}
        write_data(tmp_path / "d.csv", observations(parts), given)
        back, values = read_measurements(ventricle, tmp_path / "d.csv")[:2]
        assert list(back.parts) == list(values) == list(parts)
        for name in parts:
            np.testing.assert_array_equal(values[name], given[name])
        np.testing.assert_array_equal(back.nodes, observations(parts).nodes)


def test_a_volume_written_beside_the_first_point(ventricle, tmp_path):
    text = "node,ux,uy,uz,volume\n30,1,2,3,140.5\n31,4,5,6,\n"
    (tmp_path / "d.csv").write_text(text)
    back, values = read_measurements(ventricle, tmp_path / "d.csv")[:2]
    np.testing.assert_array_equal(values["displacement"], [[1, 2, 3], [4, 5, 6]])
    assert values["volume"] == 140.5
    np.testing.assert_array_equal(back.parts["displacement"].nodes, [30, 31])


def test_a_volume_in_netcdf(ventricle, points, tmp_path):
    data = xr.Dataset(
        {
            "displacement": (("point", "component"), LANDMARKS),
            "position": (("point", "component"), points),
            "volume": 123.4,
        }
    )
    data.to_netcdf(tmp_path / "d.nc", engine="h5netcdf")
    back, values = read_measurements(ventricle, tmp_path / "d.nc")[:2]
    assert values["volume"] == 123.4
    np.testing.assert_array_equal(back.parts["displacement"].points, points)
    data[["volume"]].to_netcdf(tmp_path / "v.nc", engine="h5netcdf")
    assert list(read_measurements(ventricle, tmp_path / "v.nc")[0].parts) == ["volume"]
    data.assign(volume=("point", [1.0, 2.0])).to_netcdf(tmp_path / "w.nc", engine="h5netcdf")
    with pytest.raises(InputError, match="volume has 2 values; give one, in mL"):
        read_measurements(ventricle, tmp_path / "w.nc")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("volume\n120\n130\n", "volume has 2 values; give one, in mL"),
        ("node,ux,uy,uz,volume\n3,0,0,0,\n", "volume has 0 values"),
        ("volume\nmuch\n", "row 1, column 'volume' is 'much', not a number"),
        ("volume\n-120\n", "volume is -120.0 mL; it must be above 0"),
        ("volume\nnan\n", "every value of volume is missing"),
        ("volume\ninf\n", "volume is inf; it must be finite"),
        ("volume:atrium\n120\n", "facet set 'atrium' is not in the mesh"),
        ("ux,uy,uz,volume\n0,0,0,1\n", "column 'node' is missing"),
    ],
)
def test_one_line_for_every_mistake_with_a_volume(ventricle, tmp_path, text, message):
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_measurements(ventricle, tmp_path / "d.csv")
    assert "\n" not in str(caught.value)
    assert "d.csv" in str(caught.value)


def test_what_no_file_can_hold(beam, tmp_path):
    two = {"left": cal.nodal_displacements(beam, [3]), "right": cal.nodal_displacements(beam, [4])}
    with pytest.raises(
        InputError,
        match="observation 'left' does not fit in a data file; there it would be called displacement",
    ):
        write_data(tmp_path / "d.csv", observations(two), dict.fromkeys(two, np.zeros((1, 3))))


NODES = "node,ux,uy,uz\n7,0.5,-2.25,3\n30,1,2,1e-7\n"


@pytest.mark.parametrize(
    "text",
    [
        NODES,
        NODES.replace(",", ";"),
        NODES.replace(",", ";").replace(".", ","),
        NODES.replace(",", "\t"),
        NODES.replace(",", "\t").replace(".", ","),
        NODES.replace(",", ", "),
        NODES.replace("\n", "\r\n"),
        "# measured by hand\n\n" + NODES.replace("\n", "\n\n# a word\n") + "\n\n",
        "\ufeff" + NODES,
        NODES.replace("uz\n", "uz,remark\n").replace("3\n", '3,"good, clear"\n'),
        NODES.replace("\n", ",\n"),
        NODES.replace("node,ux", '"node","ux"'),
    ],
)
def test_dialects_of_csv(beam, tmp_path, text):
    (tmp_path / "d.csv").write_text(text, encoding="utf-8", newline="")
    observe, data = read_measurements(beam, tmp_path / "d.csv")[:2]
    np.testing.assert_array_equal(observe.parts["displacement"].nodes, [7, 30])
    np.testing.assert_array_equal(data["displacement"], [[0.5, -2.25, 3.0], [1.0, 2.0, 1e-7]])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("d.xlsx", b"PK\x03\x04", "d.xlsx is not a readable spreadsheet"),
        ("d.csv", b"PK\x03\x04\x00", "is not a CSV file: it holds bytes"),
        ("d.csv", "n\u00f6de,ux".encode("latin-1"), "is not UTF-8 text"),
        ("d.csv", b"node,ux,uy,uz\n7,0,5,2,25,3\n", "row 1 has 6 values for 4 columns; decimal"),
        ("d.csv", b"node;ux;uy;uz\n7;1.234,5;0;0\n", "row 1, column 'ux' is '1.234,5', not a"),
        ("d.csv", b"node,ux,ux,uz\n7,0,0,0\n", "column 'ux' is there twice"),
        ("d.csv", b"7,0,1,2\n30,1,2,3\n", "its first line, '7,0,1,2', has no names of columns"),
        ("d.csv", b"7;0,5;1;2\n", "its first line, '7;0,5;1;2', has no names of columns"),
        ("d.csv", b"node,ux,uy,uz\n", "names of columns, and no row below them"),
        ("d.csv", b"", "no data; expected columns node,ux,uy,uz or"),
    ],
)
def test_files_that_cannot_be_read(beam, tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_measurements(beam, tmp_path / name)
    assert "\n" not in str(caught.value)


def test_positions_of_the_deformed_body_are_known_as_such(ventricle, points, tmp_path):
    """Where they lie outside the body at rest; a point that is nowhere near is no such thing."""
    u = np.full(points.shape, 40.0)
    u[0] = np.nan  # not seen
    for shift, hint in ((u, True), (-u, False)):
        at = np.where(np.isnan(u), points, points + shift)
        rows = [",".join(map(str, [*x, *v])) for x, v in zip(at, u, strict=True)]
        (tmp_path / "d.csv").write_text("x,y,z,ux,uy,uz\n" + "\n".join(rows))
        with pytest.raises(InputError, match="lies outside the body") as caught:
            read_measurements(ventricle, tmp_path / "d.csv")
        assert ("all points lie inside: give positions at rest" in str(caught.value)) is hint


def test_netcdf_is_written_too(ventricle, points, tmp_path):
    parts = {
        "displacement": cal.landmarks(ventricle, points),
        "volume": cal.CavityVolume(ventricle),
    }
    write_data(tmp_path / "d.nc", observations(parts), {"displacement": LANDMARKS, "volume": 9.5})
    back, values = read_measurements(ventricle, tmp_path / "d.nc")[:2]
    np.testing.assert_array_equal(values["displacement"], LANDMARKS)
    np.testing.assert_array_equal(back.parts["displacement"].points, points)
    assert values["volume"] == 9.5
