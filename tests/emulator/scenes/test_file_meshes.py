"""What a scene file takes from its mesh file: sets, directions, regions, the elements' order."""

import meshio
import numpy as np
import pytest

from emulator.catalogue import find_scene
from emulator.core.errors import InputError
from emulator.geometry.generators.box import box
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.io import write_mesh
from emulator.geometry.refinement import to_quadratic
from emulator.scenes.fibre_rules import Helix
from scene_file_support import HEART, SCENE


def test_sheets_from_the_mesh_file_or_by_rule(folder):
    mesh = human_ventricle(5, 12, 1)
    fibres, sheets = Helix((60.0, -60.0)).directions(mesh)
    write_mesh(folder / "heart.vtu", mesh, fibres, sheets)
    values = "a_s = 2.0\nb_s = 2.0\na_fs = 0.2\nb_fs = 2.0\nkappa"
    text = HEART.replace('"holzapfel_ogden"', '"holzapfel_ogden_orthotropic"')
    text = text.replace("kappa", values).replace("lv_endocardium", "endocardium")
    text = text.replace("rv_endocardium", "epicardium")
    by_rule = text.format(rule="helix", options="angles = [60, -60]")
    for written in (by_rule, text.replace('[fibres]\nrule = "{rule}"\n{options}\n', "")):
        (folder / "heart.toml").write_text(written)
        scene = find_scene(str(folder / "heart.toml"))
        np.testing.assert_allclose(scene.fibres, fibres, atol=1e-9)
        np.testing.assert_allclose(scene.sheets, sheets, atol=1e-9)
    write_mesh(folder / "heart.vtu", mesh, fibres)
    with pytest.raises(InputError, match="needs sheets, and mesh file heart.vtu has none"):
        find_scene(str(folder / "heart.toml"))
    options = "direction = [1, 0, 0]\nsheets = [0, 0, 2]"
    (folder / "heart.toml").write_text(text.format(rule="uniform", options=options))
    np.testing.assert_array_equal(find_scene(str(folder / "heart.toml")).sheets[0], [0, 0, 1])


def test_facet_sets_on_a_plane_and_quadratic_elements(folder):
    sets = "[facet_sets.end]\naxis = 'x'\nat = 2.0\n[[loads]]\nkind = 'traction'\n"
    sets += "facet_set = 'end'\ntraction = [0, 0, 1]\n[constants]"
    text = "order = 2\n" + SCENE.replace("[constants]", sets)
    (folder / "scene.toml").write_text(text)
    scene = find_scene(str(folder / "scene.toml"))
    assert scene.mesh.facet_set("end").shape == (2, 6)
    force = scene.loads[1].dead_forces(scene.discretisation)[None]
    np.testing.assert_allclose(force.sum(axis=0), [0.0, 0.0, 1.0], atol=1e-12)  # 1 mm2 of 1 kPa
    on_plane = np.flatnonzero(scene.mesh.nodes[:, 0] == 0.0)
    np.testing.assert_array_equal(scene.mesh.node_set("left"), on_plane)
    write_mesh(folder / "block.vtu", to_quadratic(box((2.0, 1.0, 1.0), (2, 1, 1))))
    assert find_scene(str(folder / "scene.toml")).mesh.order == 2
    (folder / "scene.toml").write_text(text.replace("order = 2", "order = 1"))
    with pytest.raises(InputError, match="order = 1; mesh file block.vtu has quadratic"):
        find_scene(str(folder / "scene.toml"))


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


def test_regions_come_from_cell_data(folder):
    mesh = box((2.0, 1.0, 1.0), (2, 1, 1))
    labels = np.where(mesh.nodes[mesh.elements, 0].mean(axis=1) < 1.0, 1, 2)
    cells = [("triangle", mesh.surface), ("tetra", mesh.elements)]

    def write(values):
        data = {"segment": [np.zeros(len(mesh.surface)), values]}
        meshio.write(folder / "block.vtu", meshio.Mesh(mesh.nodes, cells, cell_data=data))

    write(labels.astype(float))
    factor = '[parameters.stiffness_1]\nrange = [0.5, 2.0]\nscale = "log"\n'
    text = SCENE.replace("[constants]", factor + "[constants]\nstiffness_2 = 1.0")
    (folder / "scene.toml").write_text('regions = "segment"\n' + text)
    scene = find_scene(str(folder / "scene.toml"))
    np.testing.assert_array_equal(scene.regions, labels)
    assert scene.parameter_names == ("mu", "stiffness_1")
    write(labels + 0.5)
    with pytest.raises(InputError, match="'segment' are not one whole number for each element"):
        find_scene(str(folder / "scene.toml"))
    (folder / "scene.toml").write_text('regions = "zone"\n' + text)
    with pytest.raises(InputError, match="no cell data 'zone' for regions; has 'segment'"):
        find_scene(str(folder / "scene.toml"))
