"""Decks of hexahedra and prisms: the homogeneous states of decks of tetrahedra."""

import numpy as np
import pytest

import deck_support as decks
import emulator as em
from deck_support import SLIDING, abaqus_supports, drafted, febio_supports

X, Y, Z = np.meshgrid([0.0, 1.0, 2.0], [0.0, 1.0], [0.0, 1.0], indexing="ij")
NODES = np.stack([X, Y, Z], axis=-1).reshape(-1, 3)  # node 4 i + 2 j + k
HEXAHEDRA = [[4 * i, 4 * i + 4, 4 * i + 6, 4 * i + 2, 4 * i + 1, 4 * i + 5, 4 * i + 7, 4 * i + 3]
             for i in range(2)]  # fmt: skip
LAST = HEXAHEDRA[1]
PRISMS = [[LAST[k] for k in rows] for rows in ((0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7))]
SETS = {"left": NODES[:, 0] == 0, "right": NODES[:, 0] == 2, "front": NODES[:, 1] == 0,
        "bottom": NODES[:, 2] == 0}  # fmt: skip
RIGHT = [8, 10, 11, 9]
SMALLEST = 1e-8


def ids(nodes):
    """Numbers of nodes from 1, as decks write them."""
    return ",".join(str(int(k) + 1) for k in nodes)


def febio(cells, supports, loads, data=""):
    """A deck of format 4 of blocks of cells of a kind."""
    nodes = "".join(f'<node id="{k}">{",".join(map(str, x))}</node>'
                    for k, x in enumerate(NODES.tolist(), 1))  # fmt: skip
    blocks, number = "", 0
    for kind, rows in cells.items():
        blocks += f'<Elements type="{kind}" name="{kind}">'
        for row in rows:
            number += 1
            blocks += f'<elem id="{number}">{ids(row)}</elem>'
        blocks += "</Elements>"
    sets = "".join(f'<NodeSet name="{n}">{ids(np.flatnonzero(of))}</NodeSet>'
                   for n, of in SETS.items())  # fmt: skip
    domains = "".join(f'<SolidDomain name="{kind}" mat="tissue"/>' for kind in cells)
    law = 'type="neo-Hookean"><density>1</density><E>30</E><v>0.3</v>'
    return f"""<febio_spec version="4.0"><Module type="solid"/>
<Material><material id="1" name="tissue" {law}</material></Material>
<Mesh><Nodes name="all">{nodes}</Nodes>{blocks}{sets}
<Surface name="right"><quad4 id="1">{ids(RIGHT)}</quad4></Surface></Mesh>
<MeshDomains>{domains}</MeshDomains>{data}
<Boundary>{supports}</Boundary><Loads>{loads}</Loads></febio_spec>"""


@pytest.mark.parametrize(
    ("cells", "count"),
    [({"hex8": HEXAHEDRA}, 12), ({"hex8": HEXAHEDRA[:1], "penta6": PRISMS}, 12)],
)
def test_a_pressure_on_a_quadrilateral_of_febio(tmp_path, cells, count):
    load = ('<surface_load type="pressure" surface="right"><pressure>-2.5</pressure>'
            "</surface_load>")  # fmt: skip
    draft = drafted(tmp_path / "h.feb", febio(cells, febio_supports("4.0", SLIDING), load))
    scene = draft.scene
    assert len(scene.mesh.elements) == count
    assert scene.mesh.order == 2  # split, they would lock
    energy = decks.neo_hookean(30.0, 0.3)
    assert decks.judged(scene, energy, decks.pulled(energy, cauchy=2.5)) < SMALLEST
    assert any("hexahedra and prisms are split into tetrahedra" in note for note in draft.notes)
    assert not draft.unread


def test_directions_of_a_hexahedron_are_those_of_its_tetrahedra(tmp_path):
    law = ('type="Holzapfel-Gasser-Ogden"><c>4</c><k1>3</k1><k2>2</k2><gamma>20</gamma>'
           "<kappa>0</kappa><k>90</k>")  # fmt: skip
    rows = ("1,0,0", "0,3,4")
    elements = "".join(f'<elem lid="{k}"><a>{a}</a><d>0,4,-3</d></elem>'
                       for k, a in enumerate(rows, 1))  # fmt: skip
    data = (
        f'<MeshData><ElementData var="mat_axis" elem_set="hex8">{elements}</ElementData></MeshData>'
    )
    text = febio({"hex8": HEXAHEDRA}, febio_supports("4.0", {"left": "xyz"}), "", data)
    text = text.replace('type="neo-Hookean"><density>1</density><E>30</E><v>0.3</v>', law)
    scene = drafted(tmp_path / "d.feb", text).scene
    fibres = np.asarray(scene.fibres).reshape(12, -1, 3)
    middle = scene.mesh.nodes[scene.mesh.elements[:, :4]].mean(axis=1)
    expected = np.where(middle[:, :1] < 1.0, [1.0, 0.0, 0.0], [0.0, 0.6, 0.8])
    inner = np.abs(np.einsum("mqi,mi->mq", fibres, expected)).min(axis=1)
    assert inner.max() > 0.999  # interpolated between elements, but of the right ones
    assert np.abs(fibres.mean(axis=1) * expected).sum(axis=1).min() > 0.7


@pytest.mark.parametrize("kind", ["C3D8R", "C3D6"])
def test_faces_of_abaqus(tmp_path, kind):
    """A pressure on the end: face S4 (corners 2, 3, 7, 6) of a hexahedron, a side of a prism."""
    pairs = {"C3D8R": [(kind, HEXAHEDRA)], "C3D6": [("C3D8", HEXAHEDRA[:1]), (kind, PRISMS)]}[kind]
    face = {"C3D8R": "2, S4", "C3D6": "2, S4"}[kind]
    lines = ["*Node", *(f"{k}, {', '.join(map(str, x))}" for k, x in enumerate(NODES.tolist(), 1))]
    number = 0
    for name, rows in pairs:
        lines.append(f"*Element, type={name}, elset=body")
        for row in rows:
            number += 1
            lines.append(f"{number}, {ids(row)}")
    for name, of in SETS.items():
        lines += [f"*Nset, nset={name}", ids(np.flatnonzero(of))]
    lines += ["*Surface, name=end", face, "*Solid Section, elset=body, material=m", ","]
    lines += ["*Material, name=m", "*Hyperelastic, neo hooke", "2.0, 0.025", "*Step, nlgeom=YES"]
    lines += ["*Static", "1., 1.", abaqus_supports(), "*Dsload", "end, P, -1.5", "*End Step"]
    scene = drafted(tmp_path / "h.inp", "\n".join(lines)).scene
    energy = decks.isochoric(lambda a, b, c: 2.0 * (a**2 + b**2 + c**2 - 3), 80.0)
    assert decks.judged(scene, energy, decks.pulled(energy, cauchy=1.5)) < SMALLEST
    assert em.Simulator(scene).solve(scene.centre).converged


def test_linear_and_quadratic_elements_are_not_mixed(tmp_path):
    rows = {"hex8": HEXAHEDRA[:1], "tet10": [[*range(10)]]}
    text = febio(rows, febio_supports("4.0", {"left": "xyz"}), "")
    assert "linear and quadratic elements" in decks.complaint(tmp_path / "m.feb", text)
