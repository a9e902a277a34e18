"""What the tests of scene files share."""

import meshio
import pytest

from emulator.geometry.generators.box import box
from scene_file_support import SCENE


@pytest.fixture
def folder(tmp_path):
    """A folder with ``scene.toml`` and its mesh, a block of 2 x 1 x 1 mm."""
    mesh = box((2.0, 1.0, 1.0), (2, 1, 1))
    meshio.write(tmp_path / "block.vtu", meshio.Mesh(mesh.nodes, [("tetra", mesh.elements)]))
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path
