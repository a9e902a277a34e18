"""Decks that tests write, and the homogeneous states that they are judged by.

Every deck is of one block, 2 by 1 by 1, of linear or quadratic tetrahedra. Energies are functions of
the principal stretches, written here from the programs' manuals; their stresses are derivatives by
a complex step.
"""

import jax
import numpy as np
import pytest
from scipy.optimize import fsolve

from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.geometry.generators.box import box
from emulator.geometry.io import write_mesh
from emulator.neighbours.decks.draft import draft_deck

BLOCK, QUADRATIC = (box((2.0, 1.0, 1.0), (2, 1, 1), order=order) for order in (1, 2))
SLIDING = {"left": "x", "front": "y", "bottom": "z"}
"""The supports of a block that may stretch and thicken."""


def drafted(path, text, unit="mm,kPa"):
    """The draft of a deck of this text."""
    path.write_text(text)
    return draft_deck(path, path.parent / "scene", unit)


def complaint(path, text):
    """The one line by which a deck is refused."""
    with pytest.raises(InputError) as refusal:
        drafted(path, text)
    assert "\n" not in str(refusal.value)
    return str(refusal.value)


def listed(values, sign=","):
    return sign.join(str(v) for v in values)


# FEBio.


def _ids(nodes):
    return listed(int(k) + 1 for k in nodes)


def febio(version, material, boundary, loads="", mesh=BLOCK, more="", mat_axes=""):
    """A deck of the block in one of FEBio's formats."""
    kind, facet = ("tet4", "tri3") if mesh.order == 1 else ("tet10", "tri6")
    old = version == "2.5"
    name, mat = ("Geometry", ' mat="1"') if old else ("Mesh", "")
    lines = [f'<node id="{k}">{listed(x)}</node>' for k, x in enumerate(mesh.nodes.tolist(), 1)]
    lines = [
        '<Nodes name="Object1">',
        *lines,
        "</Nodes>",
        f'<Elements type="{kind}"{mat} name="P">',
    ]
    lines += [f'<elem id="{k}">{_ids(row)}</elem>' for k, row in enumerate(mesh.elements, 1)]
    lines.append("</Elements>")
    for set_name, nodes in mesh.node_sets.items():
        ids = _ids(nodes)
        if version != "4.0":
            tag = "node" if old else "n"
            ids = "".join(f'<{tag} id="{k}"/>' for k in ids.split(","))
        lines.append(f'<NodeSet name="{set_name}">{ids}</NodeSet>')
    for set_name, rows in mesh.facet_sets.items():
        facets = (f'<{facet} id="{k}">{_ids(row)}</{facet}>' for k, row in enumerate(rows, 1))
        lines.append(f'<Surface name="{set_name}">{"".join(facets)}</Surface>')
    domains = "" if old else '<MeshDomains><SolidDomain name="P" mat="tissue"/></MeshDomains>'
    curve = '<loadcurve id="1" type="linear"><point>0,0</point><point>1,1</point></loadcurve>'
    if not old:
        curve = (
            '<load_controller id="1" type="loadcurve"><interpolate>LINEAR</interpolate>'
            "<points><pt>0,0</pt><pt>1,1</pt></points></load_controller>"
        )
    body = "\n".join(lines)
    return f"""<?xml version="1.0" encoding="ISO-8859-1"?>
<febio_spec version="{version}">
<Module type="solid"/>
<Control><time_steps>10</time_steps><step_size>0.1</step_size></Control>
<Material><material id="1" name="tissue" {material}</material></Material>
<{name}>
{body}
</{name}>
{domains}
{mat_axes}
<Boundary>
{boundary}
</Boundary>
<Loads>
{loads}
</Loads>
<LoadData>{curve}</LoadData>
{more}
</febio_spec>
"""


def febio_supports(version, sets=SLIDING):
    """The tags that fix components of node sets."""
    form = {
        "2.5": '<fix bc="{bc}" node_set="{name}"/>',
        "3.0": '<bc type="fix" node_set="{name}"><dofs>{bc}</dofs></bc>',
        "4.0": '<bc type="zero displacement" node_set="{name}">{flags}</bc>',
    }[version]
    return "\n".join(
        form.format(
            name=name,
            bc=",".join(bc),
            flags="".join(f"<{axis}_dof>1</{axis}_dof>" for axis in bc),
        )
        for name, bc in sets.items()
    )


# Abaqus.


def abaqus_mesh(mesh=BLOCK, kind=None):
    """Nodes, elements, sets and surfaces of the block."""
    kind = kind or ("C3D4" if mesh.order == 1 else "C3D10")
    lines = ["*Node", *(f"{k}, {listed(x)}" for k, x in enumerate(mesh.nodes.tolist(), 1))]
    lines.append(f"*Element, type={kind}, elset=body")
    for k, row in enumerate(mesh.elements, 1):
        ids = [str(k), *(str(int(n) + 1) for n in row)]
        lines += [f"{listed(ids[:6])},", listed(ids[6:])] if len(ids) > 6 else [listed(ids)]
    for name, nodes in mesh.node_sets.items():
        lines += [f"*Nset, nset={name}", _ids(nodes)]
    faces = {"S1": (0, 1, 2), "S2": (0, 3, 1), "S3": (1, 3, 2), "S4": (2, 3, 0)}
    for name, rows in mesh.facet_sets.items():
        lines.append(f"*Surface, type=ELEMENT, name={name}_face")
        wanted = {frozenset(row[:3].tolist()) for row in rows}
        lines += [
            f"{k}, {face}"
            for k, element in enumerate(mesh.elements.tolist(), 1)
            for face, corners in faces.items()
            if {frozenset(element[c] for c in corners)} & wanted
        ]
    return "\n".join(lines)


def abaqus(material, conditions, mesh=BLOCK, nlgeom="YES", section="", more="", kind=None):
    """A flat deck of the block."""
    return f"""*Heading
 a block
{abaqus_mesh(mesh, kind)}
*Solid Section, elset=body, material=tissue{section}
,
{more}
*Material, name=Tissue
{material}
*Step, name=load, nlgeom={nlgeom}
*Static
0.1, 1.0
{conditions}
*End Step
"""


def abaqus_supports(sets=SLIDING, prefix=""):
    """The rows that fix components of node sets."""
    rows = [
        f"{prefix}{name}, {'xyz'.index(a) + 1}, , 0." for name, axes in sets.items() for a in axes
    ]
    return "\n".join(["*Boundary", *rows])


# Homogeneous states.


def neo_hookean(E, nu):
    """The energy of FEBio's neo-Hookean material, of the principal stretches."""
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    return lambda a, b, c: (
        mu / 2 * (a**2 + b**2 + c**2 - 3)
        - mu * np.log(a * b * c)
        + lam / 2 * np.log(a * b * c) ** 2
    )


def volumetric(J, kappa):
    """The energy U_1 of volume change."""
    return kappa / 4 * (J**2 - 1 - 2 * np.log(J))


def isochoric(shape, kappa):
    """An energy of stretches less their volume change, by ``shape(l1, l2, l3)``, and of J."""

    def energy(a, b, c):
        J = a * b * c
        return shape(*(x * J ** (-1 / 3) for x in (a, b, c))) + volumetric(J, kappa)

    return energy


def nominal(energy, stretches):
    """The nominal principal stresses (3,) by a complex step."""
    step = 1e-30
    return np.array(
        [energy(*(np.asarray(stretches) + 1j * step * np.eye(3)[k])).imag / step for k in range(3)]
    )


def pulled(energy, along=None, nominal_stress=None, cauchy=None):
    """The principal stretches of a block that is free to the sides.

    along : its stretch along x, or the nominal or the Cauchy stress there.
    """

    def residual(unknown):
        stretches = np.array([unknown[0], *unknown[1:]])
        P = nominal(energy, stretches)
        if along is not None:
            first = stretches[0] - along
        elif nominal_stress is not None:
            first = P[0] - nominal_stress
        else:
            first = P[0] - cauchy * stretches[1] * stretches[2]
        return [first, P[1], P[2]]

    solution, _, status, _ = fsolve(residual, np.ones(3), xtol=1e-14, full_output=True)
    assert np.abs(residual(solution)).max() < 1e-9, status
    return solution


def forces(scene, displacement):
    """Internal less external forces (n, 3) in mN, at the centre of the ranges: the deck's values."""
    system, theta = System(scene), scene.centre
    u = jax.numpy.asarray(displacement)
    internal = jax.jit(jax.grad(system.internal_energy))(u, theta)
    return np.asarray(internal - system.external_force(u, theta))


def imbalance(scene, displacement):
    """The largest force (mN) on a free component: zero at a solution."""
    prescribed, expected = scene.held, scene.held_displacement
    np.testing.assert_allclose(displacement[prescribed], expected[prescribed], atol=1e-12)
    return float(np.abs(forces(scene, displacement)[~prescribed]).max())


def judged(scene, energy, stretches):
    """The largest error (mN) of a block that is stretched along x, by hand.

    Of the forces on free components, which vanish, and of the one on the face x = 0, whose area is 1.
    """
    u = stretched(scene, stretches)
    held_back = forces(scene, u)[scene.mesh.nodes[:, 0] == 0.0, 0].sum()
    return max(imbalance(scene, u), float(abs(held_back + nominal(energy, stretches)[0])))


def stretched(scene, stretches):
    """The displacement (n, 3) of principal stretches."""
    return scene.mesh.nodes * (np.asarray(stretches) - 1.0)


def face_of(mesh, name, row):
    """The number of the element behind a facet of a set, and the name of its face in Abaqus."""
    wanted = frozenset(mesh.facet_set(name)[row][:3].tolist())
    faces = {"S1": (0, 1, 2), "S2": (0, 3, 1), "S3": (1, 3, 2), "S4": (2, 3, 0)}
    return next(
        (k, face)
        for k, element in enumerate(mesh.elements.tolist(), 1)
        for face, corners in faces.items()
        if frozenset(element[c] for c in corners) == wanted
    )


# svMultiPhysics.


def svmultiphysics(folder, model, conditions, directions="", mesh=BLOCK, root="svMultiPhysicsFile"):
    """A deck of the block; its mesh and faces are written beside it."""
    (folder / "mesh").mkdir(exist_ok=True)
    write_mesh(folder / "mesh" / "block.vtu", mesh)
    for name, facets in mesh.facet_sets.items():
        nodes, rows = np.unique(facets[:, :3], return_inverse=True)
        points = " ".join(f"{x!r}" for x in mesh.nodes[nodes].ravel().tolist())
        array = '<DataArray type="{}" Name="{}" format="ascii"{}>{}</DataArray>'.format
        (folder / "mesh" / f"{name}.vtp").write_text(
            '<?xml version="1.0"?><VTKFile type="PolyData" version="0.1" byte_order="LittleEndian">'
            f'<PolyData><Piece NumberOfPoints="{len(nodes)}" NumberOfPolys="{len(facets)}"><Points>'
            + array("Float64", "Points", ' NumberOfComponents="3"', points)
            + "</Points><Polys>"
            + array("Int64", "connectivity", "", listed(rows.ravel().tolist(), " "))
            + array("Int64", "offsets", "", listed(range(3, 3 * len(facets) + 1, 3), " "))
            + "</Polys></Piece></PolyData></VTKFile>"
        )
    faces = "\n".join(
        f'<Add_face name="{name}"><Face_file_path> mesh/{name}.vtp </Face_file_path></Add_face>'
        for name in mesh.facet_sets
    )
    return f"""<?xml version="1.0" encoding="UTF-8" ?>
<{root} version="0.1">
<GeneralSimulationParameters>
  <Number_of_time_steps> 10 </Number_of_time_steps>
</GeneralSimulationParameters>
<Add_mesh name="msh">
  <Mesh_file_path> mesh/block.vtu </Mesh_file_path>
  {faces}
  {directions}
</Add_mesh>
<Add_equation type="struct">
  <Coupled> true </Coupled>
  <Density> 2.0 </Density>
  {model}
  <Dilational_penalty_model> ST91 </Dilational_penalty_model>
  {conditions}
</Add_equation>
</{root}>
"""


def svmultiphysics_supports(sets=SLIDING):
    """The conditions that fix components of faces."""
    return "\n".join(
        f'<Add_BC name="{name}"><Type> Dir </Type><Value> 0.0 </Value><Effective_direction> '
        f"({', '.join(str(int(a in axes)) for a in 'xyz')}) </Effective_direction></Add_BC>"
        for name, axes in sets.items()
    )
