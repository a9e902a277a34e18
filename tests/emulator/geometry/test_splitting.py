"""Cells with quadrilateral faces as tetrahedra that fit together."""

from collections import Counter
from itertools import combinations

import meshio
import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.io import read_body
from emulator.geometry.mesh import orient, signed_volumes
from emulator.geometry.splitting import FACES, tetrahedra_of, triangles_of

UNIT = {
    5: np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]], float),
    6: np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]], float),
    8: np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1],
                 [0, 1, 1]], float),
}  # fmt: skip
VOLUMES, COUNTS = {5: 1 / 3, 6: 1 / 2, 8: 1.0}, {5: 2, 6: 3, 8: 6}


def grid(rng, cells=(3, 2, 2)):
    """Nodes (n, 3) of a grid of cubes, inner ones moved and all renumbered, and its hexahedra."""
    sizes = [count + 1 for count in cells]
    number = rng.permutation(int(np.prod(sizes))).reshape(sizes)
    places = np.stack(np.meshgrid(*map(np.arange, sizes), indexing="ij"), axis=-1).astype(float)
    inner = (slice(1, -1),) * 3
    places[inner] += rng.uniform(-0.15, 0.15, places[inner].shape)
    nodes = np.empty((number.size, 3))
    nodes[number.ravel()] = places.reshape(-1, 3)
    corners = UNIT[8].astype(int)
    hexahedra = [
        [number[tuple(np.add(origin, corner))] for corner in corners]
        for origin in np.ndindex(*cells)
    ]
    return nodes, np.array(hexahedra)


@pytest.mark.parametrize("kind", [5, 6, 8])
def test_tetrahedra_fill_a_cell_however_its_corners_are_numbered(kind):
    rng = np.random.default_rng(kind)
    for _ in range(40):
        number = rng.permutation(kind)
        nodes = np.empty((kind, 3))
        nodes[number] = UNIT[kind]
        rows, parents = tetrahedra_of(number[None])
        assert len(rows) == COUNTS[kind]
        assert not parents.any()
        volumes = np.abs(signed_volumes(nodes, rows))
        assert volumes.sum() == pytest.approx(VOLUMES[kind], rel=1e-14)
        assert volumes.min() > 0.05


def test_a_hexahedron_with_corners_twice_is_the_prism_that_it_is():
    nodes = UNIT[6]
    rows, _ = tetrahedra_of(np.array([[0, 1, 2, 2, 3, 4, 5, 5]]))
    assert len(rows) == 3
    assert np.abs(signed_volumes(nodes, rows)).sum() == pytest.approx(0.5)


def test_neighbours_cut_their_common_face_alike():
    nodes, cells = grid(np.random.default_rng(0))
    rows, parents = tetrahedra_of(cells)
    assert np.array_equal(np.bincount(parents), np.full(len(cells), 6))
    assert (np.diff(parents) >= 0).all()
    assert signed_volumes(nodes, orient(nodes, rows)).sum() == pytest.approx(12.0, rel=1e-13)
    faces = Counter(tuple(sorted(face)) for row in rows for face in combinations(row.tolist(), 3))
    outside = {face for face, count in faces.items() if count == 1}
    assert max(faces.values()) == 2
    quadrilaterals = Counter(tuple(sorted(cell[list(f)])) for cell in cells for f in FACES[8])
    whole = [f for f, count in quadrilaterals.items() if count == 1]
    assert len(outside) == 2 * len(whole) == 64
    sides = np.array([cell[list(f)] for cell in cells for f in FACES[8]
                      if quadrilaterals[tuple(sorted(cell[list(f)]))] == 1])  # fmt: skip
    assert {tuple(sorted(row)) for row in triangles_of(sides).tolist()} == outside


def test_a_file_of_hexahedra_has_its_groups_and_directions(tmp_path):
    nodes, cells = grid(np.random.default_rng(1))
    sides = np.array([cell[list(face)] for cell in cells for face in FACES[8]])
    left = sides[(nodes[sides, 0] == 0.0).all(axis=1)]
    fibres = np.random.default_rng(2).normal(size=(len(cells), 3))
    fibres /= np.linalg.norm(fibres, axis=1, keepdims=True)
    data = {"set:left": [np.zeros(len(cells)), np.ones(len(left))],
            "fibres": [fibres, np.zeros((len(left), 3))]}  # fmt: skip
    content = meshio.Mesh(nodes, [("hexahedron", cells), ("quad", left)], cell_data=data)
    for source in (content, tmp_path / "brick.vtu"):
        if source is not content:
            meshio.write(source, content)
        body = read_body(source)
        assert len(body.mesh.elements) == 6 * len(cells)
        assert "hexahedron cells as such: they are split into tetrahedra" in body.unused
        assert len(body.mesh.facet_set("left")) == 2 * len(left)
        assert np.array_equal(body.mesh.nodes[body.mesh.node_set("left"), 0], np.zeros(9))
        assert np.allclose(body.fibres, np.repeat(fibres, 6, axis=0))
        assert content.cells[0].type == "hexahedron"  # what was given stays as it is


def test_prisms_and_tetrahedra_join_hexahedra():
    nodes, cells = grid(np.random.default_rng(3), (2, 1, 1))
    first, second = cells
    prisms = [second[[0, 1, 2, 4, 5, 6]], second[[0, 2, 3, 4, 6, 7]]]
    mixed = meshio.Mesh(nodes, [("hexahedron", [first]), ("wedge", prisms)])
    body = read_body(mixed)
    assert len(body.mesh.elements) == 12
    assert signed_volumes(body.mesh.nodes, body.mesh.elements).sum() == pytest.approx(2.0)
    assert len(body.mesh.surface) == 2 * 10


def test_quadratic_hexahedra_are_refused():
    places = np.random.default_rng(4).random((20, 3))
    with pytest.raises(InputError, match="it has hexahedron20 cells; expected tetrahedra"):
        read_body(meshio.Mesh(places, [("hexahedron20", [range(20)])]))
