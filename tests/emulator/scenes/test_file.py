import meshio
import numpy as np
import pytest

from emulator.errors import InputError
from emulator.geometry.generators import box
from emulator.geometry.io import write_mesh
from emulator.scenes import find_scene, scene_from_recipe

SCENE = """
law = "neo_hookean"
mesh = "block.vtu"
[node_sets.left]
axis = "x"
at = 0.0
[[supports]]
node_set = "left"
[[loads]]
kind = "gravity"
density = 1.1
[parameters.mu]
unit = "kPa"
range = [5, 20]
scale = "log"
[constants]
lam = 30.0
"""


@pytest.fixture
def folder(tmp_path):
    mesh = box((2.0, 1.0, 1.0), (2, 1, 1))
    meshio.write(tmp_path / "block.vtu", meshio.Mesh(mesh.nodes, [("tetra", mesh.elements)]))
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path


def test_a_scene_from_a_file(folder):
    scene = find_scene(str(folder / "scene.toml"))
    assert scene.parameter_names == ("mu",)
    assert scene.constants["lam"] == 30.0
    assert scene.loads[0].density == 1.1
    np.testing.assert_array_equal(
        np.flatnonzero(scene.held.all(axis=1)), scene.mesh.node_set("left")
    )
    assert scene_from_recipe(scene.recipe).fingerprint == scene.fingerprint


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('law = "neo_hookean"', 'law = "hooke"', "law 'hooke' is unknown"),
        ('law = "neo_hookean"', "", "key 'law' is missing"),
        ('law = "neo_hookean"', 'laws = "neo_hookean"', "unknown key 'laws'"),
        ("block.vtu", "missing.vtu", "missing.vtu does not exist"),
        ("at = 0.0", "at = 0.5", "no node at x = 0.5 mm"),
        ('axis = "x"', 'axis = "w"', "node set 'left' needs axis"),
        ('kind = "gravity"', 'kind = "wind"', "load kind 'wind' is unknown"),
        ("density = 1.1", "density = -1.1", "density is -1.1"),
        ("density = 1.1", "mass = 1.1", "a value has the wrong form"),
        ("range = [5, 20]", "range = [5]", "a value has the wrong form"),
        ("range = [5, 20]", "range = [20, 5]", "range .* is empty"),
        ("lam = 30.0", "lam = ", "is not valid TOML"),
    ],
)
def test_one_line_for_every_mistake(folder, old, new, message):
    assert old in SCENE
    (folder / "scene.toml").write_text(SCENE.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        find_scene(str(folder / "scene.toml"))
    assert "\n" not in str(caught.value).replace("(at line", "")


def test_flat_elements_are_refused(folder):
    mesh = box((2.0, 1.0, 1.0), (2, 1, 1))
    flat = meshio.Mesh(mesh.nodes * [1, 1, 0], [("tetra", mesh.elements)])
    meshio.write(folder / "block.vtu", flat)
    with pytest.raises(InputError, match="no volume"):
        find_scene(str(folder / "scene.toml"))


def test_named_groups_and_fibres_come_from_the_mesh_file(folder):
    mesh = box((2.0, 1.0, 1.0), (2, 1, 1))
    fibres = np.tile([0.0, 1.0, 0.0], (len(mesh.elements), 1))
    write_mesh(folder / "block.vtu", mesh, fibres)
    text = SCENE.replace('[node_sets.left]\naxis = "x"\nat = 0.0\n', "")
    (folder / "scene.toml").write_text(text)
    scene = find_scene(str(folder / "scene.toml"))
    np.testing.assert_array_equal(scene.mesh.node_set("left"), mesh.node_set("left"))
    assert scene.fibres is None
    constants = "C = 2.0\nb_f = 8.0\nb_t = 2.0\nb_fs = 4.0"
    text = text.replace("neo_hookean", "guccione").replace("lam = 30.0", constants)
    (folder / "scene.toml").write_text(text.replace("parameters.mu", "parameters.kappa"))
    np.testing.assert_array_equal(find_scene(str(folder / "scene.toml")).fibres, fibres)


def test_unknown_names(tmp_path):
    with pytest.raises(InputError, match="scene 'beam' is unknown; built in: biventricle"):
        find_scene("beam")
    with pytest.raises(InputError, match="does not exist"):
        find_scene(str(tmp_path / "none.toml"))
    with pytest.raises(InputError, match="with --root DIR"):
        find_scene("published:OnceClampedBeam")
    with pytest.raises(InputError, match="recipe names scene 'None'"):
        scene_from_recipe({})
