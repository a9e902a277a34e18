"""Shapes of elements: against closed forms, and where a mesh is bad on purpose."""

from dataclasses import replace

import numpy as np
import pytest

from calibrate.cli import main
from emulator.geometry.discretisation import FLAT, dihedral_angles, mesh_quality
from emulator.geometry.generators.box import box
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.io import write_mesh
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_quadratic
from emulator.scenes.draft import draft_scene

REGULAR = np.array([[1.0, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]])


def test_angles_of_known_tetrahedra():
    corner = np.vstack([np.zeros(3), np.eye(3)])
    angles = dihedral_angles(Mesh(np.vstack([REGULAR, corner + 9.0]), np.arange(8).reshape(2, 4)))
    np.testing.assert_allclose(angles[0], np.degrees(np.arccos(1.0 / 3.0)))
    between = np.degrees(np.arccos(1.0 / np.sqrt(3.0)))
    np.testing.assert_allclose(np.sort(angles[1]), [between] * 3 + [90.0] * 3)


def test_a_block_has_no_bad_elements_and_one_part():
    found = mesh_quality(box((1.0, 1.0, 1.0), (2, 2, 2)))
    assert (found.parts, found.flat, found.jacobian) == (1, 0, 1.0)
    assert found.angle == pytest.approx(45.0)
    assert found.sentence().startswith("1 part; smallest dihedral angle 45 degrees, at (")
    assert "Jacobian" not in found.sentence()


def flattened(height=0.005):
    """A block with one corner of its surface pushed almost into the opposite face."""
    mesh = box((10.0, 10.0, 10.0), (2, 2, 2))
    element = mesh.elements[0, :4]
    corners = mesh.nodes[element]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    nodes = mesh.nodes.copy()
    nodes[element[3]] -= (normal @ (corners[3] - corners[0]) - height) * normal
    return replace(mesh, nodes=nodes), element[3]


def test_a_flat_element_is_found_where_it_is(tmp_path):
    mesh, moved = flattened()
    found = mesh_quality(mesh)
    assert found.flat >= 1
    assert found.angle < FLAT
    middles = mesh.nodes[mesh.elements].mean(axis=1)
    worst = np.argmin(np.linalg.norm(middles - found.place, axis=1))
    assert moved in mesh.elements[worst]
    assert f"below {FLAT:g}: remesh there" in found.sentence()
    write_mesh(tmp_path / "flat.vtu", mesh)
    notes = draft_scene(tmp_path / "flat.vtu", tmp_path / "flat.toml").notes
    assert found.sentence() in notes
    write_mesh(tmp_path / "good.vtu", box((10.0, 10.0, 10.0), (2, 2, 2)))
    assert "angle" not in " ".join(draft_scene(tmp_path / "good.vtu", tmp_path / "good.toml").notes)


def test_curved_elements_have_a_jacobian_that_varies():
    mesh = to_quadratic(human_ventricle(4, 8, 1))
    assert mesh_quality(mesh).jacobian == 1.0  # midpoints on straight edges
    nodes = mesh.nodes.copy()
    a, b, middle = mesh.elements[0, [0, 1, 4]]
    nodes[middle] += 0.2 * (nodes[b] - nodes[a])
    found = mesh_quality(replace(mesh, nodes=nodes))
    assert 0.0 < found.jacobian < 0.95
    assert f"least Jacobian {found.jacobian:.2f} of its element's mean" in found.sentence()


def test_parts_are_counted():
    one = box((1.0, 1.0, 1.0), (1, 1, 1))
    nodes = np.vstack([one.nodes, one.nodes + [5.0, 0.0, 0.0]])
    two = Mesh(nodes, np.vstack([one.elements, one.elements + len(one.nodes)]))
    assert mesh_quality(two).parts == 2
    assert mesh_quality(two).sentence().startswith("2 parts; ")


def test_from_the_command_line(tmp_path, capsys):
    mesh, _ = flattened(0.05)
    write_mesh(tmp_path / "flat.vtu", mesh)
    draft_scene(tmp_path / "flat.vtu", tmp_path / "flat.toml", law="neo_hookean")
    capsys.readouterr()
    assert main(["check", "mesh", str(tmp_path / "flat.toml")]) == 0
    assert "below 3: remesh there" in capsys.readouterr().out
