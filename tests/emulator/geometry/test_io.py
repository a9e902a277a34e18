import meshio
import numpy as np
import pytest

from emulator.errors import InputError
from emulator.geometry.generators import box
from emulator.geometry.io import read_mesh, write_displacement


def test_a_written_body_reads_back(tmp_path):
    mesh = box((1.0, 2.0, 3.0), (1, 2, 2))
    u = np.random.default_rng(0).normal(size=mesh.nodes.shape)
    path = tmp_path / "body.vtu"
    write_displacement(path, mesh, u, {"J": np.arange(len(mesh.elements), dtype=float)})
    back = read_mesh(path)
    np.testing.assert_allclose(back.nodes, mesh.nodes)
    np.testing.assert_array_equal(back.elements, mesh.elements)
    content = meshio.read(path)
    np.testing.assert_allclose(content.point_data["displacement"], u)
    np.testing.assert_allclose(content.cell_data["J"][0], np.arange(len(mesh.elements)))
    assert [file.name for file in tmp_path.iterdir()] == ["body.vtu"]


def test_nothing_half_written(tmp_path):
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1))
    with pytest.raises(ValueError, match=r"len\(point"):
        write_displacement(tmp_path / "body.vtu", mesh, np.zeros((3, 3)))
    assert not list(tmp_path.iterdir())


def test_unusable_mesh_files_are_named(tmp_path, capsys):
    with pytest.raises(InputError, match="does not exist"):
        read_mesh(tmp_path / "none.vtu")
    (tmp_path / "broken.vtu").write_text("<not xml")
    with pytest.raises(InputError, match="cannot be read as a mesh"):
        read_mesh(tmp_path / "broken.vtu")
    (tmp_path / "broken.vtk").write_text("nonsense")
    with pytest.raises(InputError, match="cannot be read as a mesh: .*header"):
        read_mesh(tmp_path / "broken.vtk")
    assert capsys.readouterr() == ("", "")
    cube = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
    )
    meshio.write(
        tmp_path / "hex.vtu", meshio.Mesh(cube.astype(float), [("hexahedron", [range(8)])])
    )
    with pytest.raises(InputError, match="no linear tetrahedra, only hexahedron"):
        read_mesh(tmp_path / "hex.vtu")
