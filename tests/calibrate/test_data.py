import numpy as np
import pytest
import xarray as xr

import calibrate as cal
from calibrate.data import read_data, write_data
from emulator.errors import InputError

VALUES = np.array([[0.1, 0.2, -3.0], [1.0, -2.0, 1e-7]])


def test_csv_round_trip(beam, tmp_path):
    for observe in (
        cal.nodal_displacements(beam, [7, 30]),
        cal.landmarks(beam, [[10.0, 5.0, 5.0], [60.0, 1.0, 2.0]]),
    ):
        write_data(tmp_path / "d.csv", observe, VALUES)
        back, values = read_data(beam, tmp_path / "d.csv")
        np.testing.assert_array_equal(values, VALUES)
        np.testing.assert_array_equal(back.points, observe.points)
        assert type(back) is type(observe)


def test_netcdf(beam, tmp_path):
    data = xr.Dataset(
        {"displacement": (("point", "component"), VALUES)}, coords={"node": ("point", [7, 30])}
    )
    data.to_netcdf(tmp_path / "d.nc", engine="h5netcdf")
    observe, values = read_data(beam, tmp_path / "d.nc")
    np.testing.assert_array_equal(observe.nodes, [7, 30])
    np.testing.assert_array_equal(values, VALUES)
    data.drop_vars("node").to_netcdf(tmp_path / "e.nc", engine="h5netcdf")
    with pytest.raises(InputError, match="needs variables displacement and node"):
        read_data(beam, tmp_path / "e.nc")
    (tmp_path / "f.nc").write_bytes((tmp_path / "d.nc").read_bytes()[:200])
    with pytest.raises(InputError, match="neither CSV .* nor readable netCDF"):
        read_data(beam, tmp_path / "f.nc")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("node,ux,uy,uz\n3,0,0,nan\n", "row 1 has a displacement that is not finite"),
        ("node,ux,uy,uz\n3,0,0,0\n400,0,0,0\n", "node 400 is unknown"),
        ("node,ux,uy,uz\n3,0,0,x\n", "row 1, column 'uz' is 'x', not a number"),
        ("node,ux,uy,uz\n3,0,0\n", "row 1, column 'uz' is 'None', not a number"),
        ("node,ux,uy\n3,0,0\n", "column 'uz' is missing"),
        ("node,ux,uy,uz\n3.5,0,0,0\n", "nodes must be whole numbers"),
        ("x,y,z,ux,uy,uz\n500,0,0,0,0,0\n", "lies outside the body"),
        ("x,y,z,ux,uy,uz\n5,nan,0,0,0,0\n", "row 1 has a position that is not finite"),
        ("", "column 'x' is missing"),
    ],
)
def test_one_line_for_every_mistake(beam, tmp_path, text, message):
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_data(beam, tmp_path / "d.csv")
    assert "\n" not in str(caught.value)
    assert "d.csv" in str(caught.value)
