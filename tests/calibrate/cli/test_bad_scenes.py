"""Bad scene files and meshes, and emulators of another scene; tests/test_bad_input.py has the rest."""

import meshio
import numpy as np
import pytest

import emulator as em
from cli_support import SCENE, answer, complaint, write_block
from emulator.geometry.generators.box import box


@pytest.fixture
def block(tmp_path):
    return write_block(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "kPa"', 'unit = "mmHg"', "parameter 'mu' is in mmHg; law 'neo_hookean' takes kPa"),
        ("lam = 30.0", "lam = -30.0", "parameter 'lam' is -30 kPa; it must be above 0"),
        ("lam = 30.0", "nu = 0.3", "parameter 'nu' is not one of law 'neo_hookean'"),
        ('law = "neo_hookean"', 'law = "guccione"', "law 'guccione' needs fibres"),
        ('kind = "gravity"', 'kind = "weight"', 'kind = "weight"; expected'),
        ('kind = "gravity"', 'kind = "pressure"', "; did you mean 'cavity_pressure'?"),
        (
            'node_set = "left"',
            'node_set = "left"\nglue = 1',
            "unknown key 'glue'; known: amount, components",
        ),
        (
            "[[loads]]",
            '[[supports]]\nnode_set = "left"\ndisplacement = [1, 0, 0]\n[[loads]]',
            "support on 'left' contradicts another one at node",
        ),
    ],
)
def test_bad_scene_files(capsys, block, old, new, message):
    assert old in SCENE
    block.write_text(SCENE.replace(old, new))
    said = complaint(capsys, "simulate", block)
    assert "scene.toml" in said
    assert message in said


def test_bad_meshes_in_scene_files(capsys, block):
    mesh = box((20.0, 10.0, 10.0), (2, 1, 1))
    solid = ("tetra", mesh.elements)
    brick = ("hexahedron20", [[*range(12), *range(8)]])
    meshio.write(block.parent / "block.vtu", meshio.Mesh(mesh.nodes, [solid, brick]))
    assert "it has hexahedron20 cells" in complaint(capsys, "simulate", block)
    tags = [np.zeros(len(mesh.elements), int), np.array([7, 8])]
    data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    cells = [solid, ("triangle", mesh.surface[:2])]
    named = {"wall": np.array([8, 2])}
    file = meshio.Mesh(mesh.nodes, cells, cell_data=data, field_data=named)
    meshio.write(block.parent / "block.msh", file, file_format="gmsh22", binary=False)
    block.write_text(SCENE.replace("block.vtu", "block.msh"))
    assert "physical group 7 (triangles) has no name" in complaint(capsys, "simulate", block)


def test_a_scene_without_a_shipped_emulator_says_so(capsys, block):
    words = ("--truth", "mu=7", "--observe", "all")
    line = complaint(capsys, "identify", "before", block, *words)
    assert "is neither shipped nor a folder with emulator.json" in line


@pytest.mark.slow
def test_a_posterior_of_another_emulator_is_not_certified(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    from emulator.surrogates import load, save_emulator

    emulator = load("once_clamped_beam")
    save_emulator(emulator, "mine")
    words = ["--truth", "mu=73", "lam=61", "--emulator", "mine", "--warmup", 10, "--draws", 10]
    code, _ = answer(capsys, "infer", "once_clamped_beam", *words, "--no-certify", "--out", "r")
    assert code == 0
    from dataclasses import replace

    series = replace(emulator.taylor, displacement=1.01 * emulator.taylor.displacement)
    save_emulator(replace(emulator, taylor=series), "mine")
    assert "was made with another emulator map" in complaint(
        capsys, "certify", "r", "--draws", "30"
    )


def test_a_mesh_with_a_flat_element(capsys, block):
    mesh = box((20.0, 10.0, 10.0), (2, 1, 1))
    elements = mesh.elements.copy()
    elements[5, 3] = elements[5, 2]
    meshio.write(block.parent / "block.vtu", meshio.Mesh(mesh.nodes, [("tetra", elements)]))
    assert "block.vtu: element 5 has no volume, 1 such of 12" in complaint(
        capsys, "simulate", block
    )


@pytest.mark.parametrize(
    "value", ["[" * 20_000 + "]" * 20_000, "{a = " * 20_000 + "1" + "}" * 20_000]
)
def test_toml_that_is_nested_deep_is_refused_in_a_line(capsys, tmp_path, value):
    path = tmp_path / "deep.toml"
    path.write_text(f"scene = {value}\n")
    for command in ("simulate", "infer"):
        said = complaint(
            capsys, command, path, *(["--out", tmp_path / "run"] * (command == "infer"))
        )
        assert "deep.toml is not valid TOML: tables or lists are nested deeper than 100" in said


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "frame.txt",
            "***\n*** Step size: x 40\n***\nCOORDINATE_X,COORDINATE_Y,DISPLACEMENT_X\n1,2,3\n",
            "frame.txt is a frame of DICe, in pixels with y down: write its points as point,x,y",
        ),
        ("log.txt", "*Step = 1\n*Time = 0.1\n*Data = x;y\n1 0.5 0.5\n", "is a log of FEBio: write"),
        ("m.feb", "<febio_spec/>", "<febio_spec>; expected <febio_spec>, version 2.5, 3.0, 4.0"),
        ("m.vtu", '<?xml version="1.0"?><febio_spec/>', "it is FEBio's"),
        ("m.pts", "1\n0 0 0\n", "it is openCARP's; meshtool convert -imsh=m -omsh=m -ofmt=vtk"),
    ],
)
def test_files_of_other_programs_are_named(capsys, tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    assert message in complaint(capsys, "init", tmp_path / name)


def test_a_heart_that_its_own_weight_would_bend_far(capsys, tmp_path):
    """A mesh without sets gets no other load; upright it hangs still, on its side it does not."""
    body = em.find_scene("left_ventricle").mesh
    for name, axes, notes in (("upright", [0, 1, 2], 0), ("lying", [2, 0, 1], 1)):
        nodes = 93.0 / 85.0 * np.asarray(body.nodes)[:, axes]
        path = tmp_path / f"{name}.vtu"
        meshio.write(path, meshio.Mesh(nodes, [("tetra10", np.asarray(body.elements))]))
        _, result = answer(capsys, "init", path)
        fall = [note for note in result["notes"] if "its own weight moves it by 18" in note]
        assert len(fall) == notes
