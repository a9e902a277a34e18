"""Decks of svMultiPhysics and svFSIplus: XML, with meshes and faces in VTK's files beside it.

Faces are joined to the mesh by the coordinates of their nodes. A Neumann value is a pressure that
pushes into the tissue. The state at the end of a time table is read.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from emulator.geometry.file_formats import read_cells
from emulator.geometry.io import read_body, read_mesh
from emulator.geometry.mesh import Mesh, find_rows
from emulator.geometry.splitting import triangles_of
from emulator.neighbours.decks.deck import (
    AXES,
    Assembled,
    Deck,
    DeckFile,
    finished,
    only_material,
    weight,
)
from emulator.neighbours.decks.materials import OTHER, QUADRATIC, Material, split_neo_hookean
from emulator.neighbours.decks.tags import Tag, number, read_tags
from emulator.scenes.loads import DeadPressure, FollowerPressure
from emulator.scenes.part import Load
from emulator.scenes.supports import ElasticSupport

ROOTS = ("svMultiPhysicsFile", "svFSIFile")
_EQUATIONS = ("struct", "ustruct")
_NEO_HOOKEAN = ("nHK", "nHK91", "neoHookean", "neoHookeanSimo91")
_HOLZAPFEL_OGDEN = ("HO", "HolzapfelOgden")
_BULKS = {
    **dict.fromkeys(("ST91", "Simo-Taylor91"), ""),
    **dict.fromkeys(("quad", "Quad", "quadratic", "Quadratic"), QUADRATIC),
    **dict.fromkeys(("M94", "Miehe94"), OTHER),
}
_SETTINGS = {"Coupled", "Min_iterations", "Max_iterations", "Tolerance", "Density", "LS", "Output",
             "Elasticity_modulus", "Poisson_ratio", "Constitutive_model", "Penalty_parameter",
             "Dilational_penalty_model", "Momentum_stabilization_coefficient", "Add_BC",
             "Continuity_stabilization_coefficient", "Force_x", "Force_y", "Force_z",
             "Domain"}  # fmt: skip
_OF_MESH = {"Mesh_file_path", "Mesh_scale_factor", "Add_face", "Fiber_direction",
            "Fiber_direction_file_path"}  # fmt: skip
_NEAR = 1e-6  # of the body's size, within which nodes of a face and of the mesh are the same


def read_svmultiphysics(file: DeckFile) -> Deck:
    """Return the content of a deck of svMultiPhysics."""
    root = read_tags(file)
    if root.name not in ROOTS:
        raise file.error(root.line, f"<{root.name}>; expected <{ROOTS[0]}>")
    meshes, equations = [*root.all("Add_mesh")], [*root.all("Add_equation")]
    if len(meshes) != 1 or len(equations) != 1:
        raise file.error(
            root.line, f"{len(meshes)} meshes and {len(equations)} equations; expected one of each"
        )
    (equation,) = equations
    if (kind := equation.attributes.get("type", "")) not in _EQUATIONS:
        raise file.error(equation.line, f"equation '{kind}'; expected {' or '.join(_EQUATIONS)}")
    for tag in root.children:
        if tag.name not in ("GeneralSimulationParameters", "Add_mesh", "Add_equation"):
            file.skip(tag.line, tag.described())
    mesh, fibres, sheets = _mesh(file, meshes[0])
    domains = [*equation.all("Domain")] or [equation]
    if len(domains) > 1:
        raise file.error(domains[1].line, "a second domain; a scene has one material")
    material = only_material(file, {"": _material(file, domains[0])}, {"": domains[0].line})
    prescribed, springs, loads = _conditions(file, equation, mesh)
    acceleration = [number(file, domains[0], f"Force_{axis}", 0.0) for axis in AXES]
    loads += weight([(material.density or 1.0) * x for x in acceleration])
    for tag in equation.children:
        if tag.name not in _SETTINGS:
            file.skip(tag.line, f"{tag.described()} in Add_equation")
    axes = fibres, sheets
    body = Assembled(mesh, np.arange(len(mesh.elements)))
    return finished("svMultiPhysics", file, body, material, prescribed, loads, axes, springs)


def _mesh(file: DeckFile, tag: Tag) -> tuple[Mesh, np.ndarray | None, np.ndarray | None]:
    """Return the mesh with its faces, and the directions of its elements."""
    path_tag = tag.first("Mesh_file_path")
    if path_tag is None:
        raise file.error(tag.line, "no <Mesh_file_path>")
    mesh = read_mesh(file.neighbour(path_tag.text, path_tag.line))
    tree, facet_sets = cKDTree(mesh.nodes), {}
    for face in tag.all("Add_face"):
        where = face.first("Face_file_path")
        if where is None:
            file.skip(face.line, face.described())
            continue
        content = read_cells(file.neighbour(where.text, where.line))
        away, near = tree.query(np.asarray(content.points, dtype=float))
        rows = [near[b.data[:, :3]] for b in content.cells if b.type.startswith("triangle")]
        rows += [triangles_of(near[b.data]) for b in content.cells if b.type == "quad"]
        corners = np.concatenate(rows) if rows else np.empty((0, 3), int)
        hits = find_rows(corners, mesh.surface[:, :3])
        if not len(hits) or (hits < 0).any() or away.max() > _NEAR * mesh.size:
            raise file.error(where.line, f"face '{where.text}' is not on the surface of the mesh")
        facet_sets[face.attributes.get("name", "")] = mesh.surface[np.unique(hits)]
    for child in tag.children:
        if child.name not in _OF_MESH:
            file.skip(child.line, f"{child.described()} in Add_mesh")
    directions = [_fibres(file, mesh, child)
                  for child in tag.all("Fiber_direction", "Fiber_direction_file_path")]  # fmt: skip
    node_sets = {name: np.unique(rows) for name, rows in facet_sets.items()}
    scale = number(file, tag, "Mesh_scale_factor", 1.0)
    scaled = Mesh(scale * mesh.nodes, mesh.elements, node_sets, facet_sets)
    fibres, sheets = [*directions, None, None][:2]
    return scaled, fibres, sheets


def _fibres(file: DeckFile, mesh: Mesh, tag: Tag) -> np.ndarray:
    """Return unit vectors (m, 3) of a constant direction, or of a file of one for each element."""
    if tag.name == "Fiber_direction":
        vector = np.array(file.numbers(tag.text.strip("() "), tag.line, 3))
        return np.tile(vector / np.linalg.norm(vector), (len(mesh.elements), 1))
    body = read_body(file.neighbour(tag.text, tag.line))
    fibres = body.fibres if body.fibres is not None else body.sheets
    if fibres is None or len(fibres) != len(mesh.elements):
        raise file.error(tag.line, f"'{tag.text}' has no direction for each element of the mesh")
    return fibres if fibres.ndim == 2 else fibres.mean(axis=1)


def _material(file: DeckFile, tag: Tag) -> Material:
    model = tag.first("Constitutive_model")
    if model is None:
        raise file.error(tag.line, "no <Constitutive_model>")
    kind = model.attributes.get("type", "")
    penalty = tag.first("Penalty_parameter")
    kappa = None if penalty is None else number(file, tag, "Penalty_parameter")
    nu = number(file, tag, "Poisson_ratio", 0.0)
    E = number(file, tag, "Elasticity_modulus", 0.0)
    if kappa is None and not nu < 0.5:
        raise file.error(
            tag.line, f"Poisson's ratio {nu:g} without a penalty; it must be below 0.5"
        )
    law, values = split_neo_hookean(E, nu, kappa)
    if kind in _HOLZAPFEL_OGDEN:
        names = {"a": "a", "b": "b", "a_f": "a4f", "b_f": "b4f", "a_s": "a4s", "b_s": "b4s",
                 "a_fs": "afs", "b_fs": "bfs"}  # fmt: skip
        shape = {ours: number(file, model, name) for ours, name in names.items()}
        law, values = "holzapfel_ogden_orthotropic", {**shape, "kappa": 0.25 * values["kappa"]}
        file.note("fibres switch on at once here, and over a range of stretch in the deck (k)")
    elif kind not in _NEO_HOOKEAN:
        raise file.error(
            model.line, f"model '{kind}' is no law of this package; it reads neoHookean and "
            "HolzapfelOgden",
        )  # fmt: skip
    volumetric = tag.words("Dilational_penalty_model", "ST91")
    density = number(file, tag, "Density", 1.0)
    return Material(law, values, model.line, density, _BULKS.get(volumetric, volumetric))


def _conditions(
    file: DeckFile, equation: Tag, mesh: Mesh
) -> tuple[dict[tuple[str, int], float], list[ElasticSupport], list[Load]]:
    """Return prescribed displacements by face and component, springs, and loads."""
    prescribed: dict[tuple[str, int], float] = {}
    springs: list[ElasticSupport] = []
    loads: list[Load] = []
    for tag in equation.all("Add_BC"):
        name, kind = tag.attributes.get("name", ""), tag.words("Type")
        file.known(name, mesh.facet_sets, "face", tag.line)
        time = tag.words("Time_dependence", "Steady")
        fault = "" if time in ("Steady", "Unsteady") else f"Time_dependence {time}"
        if kind in ("Dir", "Dirichlet") and not fault:
            value = _value(file, tag)
            words = tag.words("Effective_direction", "1 1 1").strip("() ")
            along = file.numbers(words, tag.line, 3)
            displaced = tag.words("Impose_on_state_variable_integral", "false") in ("true", "1")
            if value == 0.0 or displaced:
                prescribed |= {(name, k): value * x for k, x in enumerate(along) if x}
                continue
            fault = "a velocity"
        elif kind in ("Neu", "Neumann") and not fault:
            follows = tag.words("Follower_pressure_load", "false") in ("true", "1")
            loads.append((FollowerPressure if follows else DeadPressure)(name, _value(file, tag)))
            continue
        elif kind == "Robin" and tag.first("Robin_vtp_file_path") is None:
            normal = tag.words("Apply_along_normal_direction", "0") in ("true", "1")
            direction = "normal" if normal else "all"
            stiffness = number(file, tag, "Stiffness")
            springs.append(ElasticSupport(name, stiffness, direction))  # type: ignore[arg-type]
            if tag.first("Damping") is not None:
                file.skip(tag.line, f"damping on '{name}', which statics has not")
            continue
        file.skip(tag.line, f"condition {kind} on '{name}'{f', {fault}' if fault else ''}")
    return prescribed, springs, loads


def _value(file: DeckFile, tag: Tag) -> float:
    """Return the value of a condition: its last one, where a file has a table of them."""
    table = tag.first("Temporal_values_file_path")
    if table is None:
        return number(file, tag, "Value")
    path = file.neighbour(table.text, table.line)
    rows = path.read_text(encoding="utf-8", errors="replace").split("\n")
    last = [row for row in rows[1:] if row.strip()][-1:]
    if not last:
        raise file.error(table.line, f"'{table.text}' has no values")
    return file.numbers(last[0], table.line, 2)[1]
