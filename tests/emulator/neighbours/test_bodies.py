"""Bodies in other programs' formats, and what the programs make of them where they are installed."""

import importlib.util
import re
import shutil
import subprocess
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest

from card_support import blocks, run
from emulator.core.errors import SolverError
from emulator.geometry.discretisation import discretise
from emulator.geometry.generators.box import box
from emulator.geometry.refinement import to_quadratic
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import LAWS
from emulator.mechanics.laws.law import quadratic, quadratic_logarithmic
from emulator.neighbours.cards import PROGRAMS, ExportedBody, write_card
from emulator.neighbours.cards.card import across_any
from law_support import ARGUMENTS

MEAN = np.array([[0.06, 0.05, 0.0], [0.0, -0.04, 0.03], [0.02, 0.0, -0.03]])
MESHES = {1: box((3.0, 2.0, 1.0), (2, 2, 1))}
MESHES[2] = to_quadratic(MESHES[1])


def directions(count):
    rng = np.random.default_rng(0)
    fibres, other = rng.normal(size=(2, count, 3))
    sheets = np.cross(fibres, other)
    return tuple(v / np.linalg.norm(v, axis=1, keepdims=True) for v in (fibres, sheets))


def body_of(law, order=1):
    mesh = MESHES[order]
    fibres, sheets = directions(len(mesh.elements))
    return ExportedBody(mesh, fibres if law.fibres else None, sheets if law.sheets else None)


def parameters(name):
    values = dict(zip((q.name for q in LAWS[name].quantities), ARGUMENTS[name], strict=True))
    return values | ({"kappa": 20.0 * values["kappa"]} if "kappa" in values else {})


def displacement(mesh):
    return mesh.nodes @ MEAN.T + 3e-3 * np.random.default_rng(1).normal(size=mesh.nodes.shape)


def our_forces(name, order, *, square=False):
    """Nodal forces (n, 3) in mN; ``square`` for the volumetric penalty of decks."""
    law, values, mesh = LAWS[name], parameters(name), MESHES[order]
    grid, axes = discretise(mesh), np.stack(directions(len(mesh.elements)), axis=1)

    def energy(H, at):
        strain = Strain(H, None, at)
        W = law.energy(strain, *map(jnp.asarray, values.values()))
        if square and "kappa" in values:
            kappa = jnp.asarray(values["kappa"])
            W += quadratic(strain, kappa) - quadratic_logarithmic(strain, 0.25 * kappa)
        return W

    def total(u):
        H = jnp.einsum("mai,mqaj->mqij", u[grid.connectivity], grid.gradients)
        of_points = jax.vmap(jax.vmap(energy, (0, None)))(H, jnp.asarray(axes))
        return jnp.sum(grid.weights * of_points)

    return np.asarray(jax.jit(jax.grad(total))(jnp.asarray(displacement(mesh))))


@pytest.mark.parametrize(
    ("order", "name"),
    [(1, "holzapfel_ogden"), (1, "neo_hookean"), (1, "ogden_2"), (2, "guccione")],
)
def test_felupe_has_our_forces(name, order, tmp_path):
    """Quadratic elements differ by FElupe's quadrature points, which have eight digits."""
    pytest.importorskip("felupe", reason="felupe is not installed")
    program, law = PROGRAMS["felupe"], LAWS[name]
    (tmp_path / "mean.py").write_text(write_card(program, law, parameters(name)))
    program.write_body(tmp_path, body_of(law, order))
    spec = importlib.util.spec_from_file_location("case", tmp_path / "case.py")
    case = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(case)
    field, solid = case.build()
    field[0].values[:] = displacement(MESHES[order])
    theirs = solid.assemble.vector(field).toarray().reshape(-1, 3)
    ours = our_forces(name, order)
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-6 * np.abs(ours).max())


@pytest.mark.parametrize(
    ("order", "name"),
    [
        (1, "neo_hookean_split"),
        (1, "yeoh"),
        (1, "ogden_2"),
        (1, "small_strain"),
        (2, "holzapfel_gasser_ogden"),
    ],
)
def test_calculix_has_our_forces(name, order, tmp_path):
    """To the seven digits that it prints."""
    if shutil.which("ccx") is None:
        pytest.skip("ccx is not installed")
    program, law, u = PROGRAMS["calculix"], LAWS[name], displacement(MESHES[order])
    (tmp_path / "mean.inp").write_text(write_card(program, law, parameters(name)))
    program.write_body(tmp_path, body_of(law, order))
    step = "*STEP" if name.startswith("small") else "*STEP, NLGEOM"
    lines = [(tmp_path / "body.inp").read_text() + step, "*STATIC", "1., 1.", "*BOUNDARY"]
    lines += [f"{k + 1}, {c + 1}, {c + 1}, {u[k, c]:.12e}" for k, c in np.ndindex(u.shape)]
    lines += ["*NODE PRINT, NSET=ALL", "RF", "*END STEP", ""]
    (tmp_path / "job.inp").write_text("\n".join(lines))
    done = subprocess.run(["ccx", "job"], cwd=tmp_path, capture_output=True, check=False)
    if done.returncode:
        raise SolverError(done.stdout.decode()[-2000:])
    rows = re.findall(r"^ +\d+ +(\S+) +(\S+) +(\S+)$", (tmp_path / "job.dat").read_text(), re.M)
    theirs, ours = 1e3 * np.array(rows, float), our_forces(name, order, square=True)
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=2e-6 * np.abs(ours).max())


@pytest.mark.parametrize("order", [1, 2])
def test_a_body_of_febio(order, tmp_path):
    body = body_of(LAWS["holzapfel_gasser_ogden"], order)
    assert PROGRAMS["febio"].write_body(tmp_path, body) == ["body.feb"]
    root = ElementTree.parse(tmp_path / "body.feb").getroot()
    nodes = [[float(x) for x in node.text.split(",")] for node in root.iter("node")]
    np.testing.assert_allclose(nodes, body.mesh.nodes, atol=1e-11)
    elements = root.find("Mesh/Elements")
    assert elements.get("type") == {1: "tet4", 2: "tet10"}[order]
    rows = [[int(x) - 1 for x in each.text.split(",")] for each in elements]
    np.testing.assert_array_equal(rows, body.mesh.elements)
    sets = {each.get("name") for each in root.iter("NodeSet")}
    assert sets == body.mesh.node_sets.keys()
    surfaces = {each.get("name"): len(each) for each in root.iter("Surface")}
    assert surfaces == {name: len(rows) for name, rows in body.mesh.facet_sets.items()}
    axes = [[[float(x) for x in each.find(tag).text.split(",")] for tag in "ad"]
            for each in root.find("MeshData/ElementData")]  # fmt: skip
    np.testing.assert_allclose(axes, body.axes, atol=1e-11)


def test_a_body_of_abaqus(tmp_path):
    body = body_of(LAWS["holzapfel_gasser_ogden"])
    assert PROGRAMS["abaqus"].write_body(tmp_path, body) == ["body.inp"]
    read = dict(blocks((tmp_path / "body.inp").read_text()))
    nodes = np.array(read["NODE, NSET=ALL"], float).reshape(-1, 4)
    np.testing.assert_allclose(nodes[:, 1:], body.mesh.nodes, atol=1e-11)
    elements = np.array(read["ELEMENT, TYPE=C3D4, ELSET=BODY"], int).reshape(-1, 5)
    np.testing.assert_array_equal(elements[:, 1:] - 1, body.mesh.elements)
    axes = read["DISTRIBUTION, NAME=FIBRE_AXES, LOCATION=ELEMENT, TABLE=TWO_VECTORS"][7:]
    rows = np.array(axes, float).reshape(-1, 7)
    np.testing.assert_allclose(rows[:, 1:], body.axes.reshape(-1, 6), atol=1e-11)
    assert "SOLID SECTION, ELSET=BODY, MATERIAL=TISSUE, ORIENTATION=FIBRES" in read


def test_a_body_of_pulse(tmp_path):
    body = body_of(LAWS["holzapfel_ogden"])
    assert PROGRAMS["pulse"].write_body(tmp_path, body) == ["body.xdmf", "body.npz", "case.py"]
    mesh = meshio.read(tmp_path / "body.xdmf")
    np.testing.assert_allclose(mesh.points, body.mesh.nodes)
    np.testing.assert_array_equal(mesh.cells_dict["tetra"], body.mesh.elements)
    with np.load(tmp_path / "body.npz") as arrays:
        np.testing.assert_array_equal(arrays["f0"], body.fibres)
        np.testing.assert_allclose(np.sum(arrays["s0"] * arrays["f0"], axis=1), 0.0, atol=1e-15)
    compile((tmp_path / "case.py").read_text(), "case.py", "exec")


@pytest.mark.parametrize("law", ["holzapfel_ogden_orthotropic", "mooney_rivlin"])
def test_a_body_of_svmultiphysics_has_two_directions(law, tmp_path):
    body = body_of(LAWS[law])
    names = PROGRAMS["svmultiphysics"].write_body(tmp_path, body)
    assert names == ["body.vtu", "fibres.vtu", "sheets.vtu"]
    mesh, fibres, sheets = (meshio.read(tmp_path / name) for name in names)
    np.testing.assert_array_equal(mesh.cell_data["GlobalElementID"][0][:2], [1, 2])
    np.testing.assert_array_equal(mesh.point_data["GlobalNodeID"][:2], [1, 2])
    f, s = fibres.cell_data["FIB_DIR"][0], sheets.cell_data["FIB_DIR"][0]
    np.testing.assert_allclose(np.sum(f * s, axis=1), 0.0, atol=1e-12)
    if body.fibres is not None:
        np.testing.assert_allclose(f, body.fibres)


def test_a_sheet_is_across_its_fibre():
    fibres = directions(40)[0]
    sheets = across_any(np.concatenate([fibres, np.eye(3)]))
    np.testing.assert_allclose(np.sum(sheets[:40] * fibres, axis=1), 0.0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(sheets, axis=1), 1.0)


def test_a_material_without_fibres_needs_none_in_pulse():
    card = write_card(PROGRAMS["pulse"], LAWS["neo_hookean_split"], parameters("neo_hookean_split"))
    assert set(run(card.replace("import pulse", ""))) >= {"material", "compressibility"}
