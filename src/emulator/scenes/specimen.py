r"""Specimens: pieces of tissue in a testing machine, in homogeneous states.

Uniaxial, biaxial and shear tests deform the middle of a piece evenly. A specimen is a scene with
one tetrahedron of corners :math:`0, e_x, e_y, e_z` (mm) for each state of
:mod:`emulator.scenes.states`, or for each point of a tube's wall in each state
(:mod:`emulator.scenes.tube`): node k moves by column k of H, and FEM of it is exact. Supports hold
what is prescribed. A pull P along axis i is a dead force on corner :math:`e_i`, whose work
:math:`V P H_{ii}` in the volume V of 1/6 mm3 makes it P/6 mN.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from emulator.core.cells import PROTOCOL, read_cells
from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh
from emulator.scenes.loads.force import MN_PER_N, Force
from emulator.scenes.scene import Scene
from emulator.scenes.states import AXES, States, motion_columns, pull_columns, states, with_unit
from emulator.scenes.supports.dirichlet import Support
from emulator.scenes.tube import Tube
from emulator.scenes.tube import motion_columns as tube_columns

_APART = 2.0  # mm between the tetrahedra of two states
_VOLUME = 1.0 / 6.0  # mm3, of a tetrahedron
_CONVENTION = re.compile(r"(lambda|λ|sigma|σ)_?([xyzXYZ]{1,2})")
_CORNER = "corner."  # before the names of the sets that are held or pulled; other sets are tests


def body_of(given: States) -> tuple[Mesh, tuple[Support, ...], tuple[Force, ...]]:
    """Return the tetrahedra of states side by side, the supports that prescribe them, and pulls.

    Sets are ``corner.origin``, ``corner.x`` and so on, and each test by its name.
    """
    H, free, pulls, protocols = given
    count = len(H)
    side = int(np.ceil(count ** (1.0 / 3.0)))
    places = np.stack(np.unravel_index(np.arange(count), (side, side, side)), axis=1)
    corners = np.vstack([np.zeros(3), np.eye(3)])
    nodes = (_APART * places[:, None] + corners).reshape(-1, 3)
    elements = np.arange(4 * count).reshape(count, 4)
    sets = {f"{_CORNER}origin": elements[:, 0]}
    supports, forces = [Support(f"{_CORNER}origin")], list[Force]()
    for k, axis in enumerate(AXES):
        name, held = f"{_CORNER}{axis}", np.flatnonzero(~free[:, k])
        sets[name] = elements[:, k + 1]
        supports.append(Support(name, H[:, :, k], components=AXES.replace(axis, "")))
        if len(held):
            sets[f"{name}.held"] = elements[held, k + 1]
            supports.append(Support(f"{name}.held", H[held, :, k], components=axis))
        if len(pulled := np.flatnonzero(pulls[:, k])):
            sets[f"{name}.pulled"] = elements[pulled, k + 1]
            along = _VOLUME / MN_PER_N * pulls[pulled, k, None] * np.eye(3)[k]
            forces.append(Force(f"{name}.pulled", along))
    tests = {name: elements[rows].ravel() for name, rows in protocols.items() if name}
    return Mesh(nodes, elements, {**tests, **sets}), tuple(supports), tuple(forces)


def specimen(
    given: States | Mapping[str, Any],
    *,
    ordered: bool = True,
    tube: Tube | None = None,
    **entries: Any,
) -> Scene:
    """Return the scene of a specimen.

    Parameters
    ----------
    given : its states, or the columns (m,) of :func:`~emulator.scenes.states.states`, of one test.
    ordered : see there.
    tube : the sector of a tube whose motion ``given`` is, see :mod:`emulator.scenes.tube`. With
        several layers, region k of the scene is layer k, from the inside.
    entries : the fields of a :class:`Scene` besides mesh, supports and pulls; fibres and sheets may
        be one direction (3,).
    """
    if not isinstance(given, States):
        given = states_in(given, tube=tube, ordered=ordered)
    mesh, supports, pulls = body_of(given)
    for name in ("fibres", "sheets"):
        if entries.get(name) is not None:
            entries[name] = np.broadcast_to(entries[name], (len(mesh.elements), 3))
    if tube is not None:
        entries |= {"tube": tube, "regions": tube.regions(len(mesh.elements))}
    entries["loads"] = (*pulls, *entries.get("loads", ()))
    return Scene(mesh=mesh, supports=supports, **{"name": "specimen", **entries})


def states_in(
    columns: Mapping[str, Any],
    protocols: list[str] | None = None,
    *,
    tube: Tube | None = None,
    ordered: bool = True,
) -> States:
    """Return the states that columns (m,) of a table describe, of a piece or of a tube's wall."""
    read = states if tube is None else tube.states
    return read(columns, protocols, ordered=ordered)


def read_states(path: Path, tube: Tube | None = None) -> States:
    """Return the states of a table's rows; the column ``protocol`` names their tests."""
    cells = read_cells(path)
    moving = motion_columns if tube is None else tube_columns
    words, rows = moving(cells.words), list(cells.rows)
    if tube is not None and (pulls := pull_columns(cells.words)):
        raise InputError(
            f"data file {path}, column '{min(pulls.values())}': a tube is stretched and inflated, "
            "not pulled by a given stress; give stretch_axial, pressure and force_axial"
        )
    if tube is None and not words and (of_tube := tube_columns(cells.words)):
        raise InputError(
            f"data file {path} is of a tube ({', '.join(of_tube)}); give the sector that it opens "
            "to: calibrate init --tube, or [tube] in the scene file"
        )
    if not words:
        raise InputError(
            f"data file {path}: no column says how the specimen moves: stretch_x, strain_x or "
            f"shear_xy{_likely(cells.words)}; it has {', '.join(filter(None, cells.words))}"
        )
    columns = {w: np.array([cells.number(k, w, gaps=True) for k in rows]) for w in words}
    names = [cells.rows[k][PROTOCOL] for k in rows] if PROTOCOL in cells.words else None
    try:
        if names is not None and "" in names:
            row = names.index("") + 1
            raise InputError(f"row {row}, column '{PROTOCOL}' is empty; name the row's test")
        return states_in(columns, names, tube=tube)
    except InputError as error:
        raise InputError(f"data file {path}: {error}") from error


def _likely(words: Sequence[str]) -> str:
    """Return which names the columns of other conventions may have to get, in words."""
    renamed = []
    for word in words:
        name, unit = with_unit(word)
        found = _CONVENTION.fullmatch(name)
        if found is not None:
            own = "stretch" if found[1] in ("lambda", "λ") else "cauchy"
            renamed.append(f"{word} {own}_{found[2][0].lower()}{f' [{unit}]' if unit else ''}")
    return f"; call {', '.join(renamed)} if they are that" if renamed else ""


def is_specimen(scene: Scene) -> bool:
    """Return whether each element is a body of its own, so that its state is homogeneous."""
    return scene.mesh.order == 1 and len(scene.mesh.nodes) == scene.mesh.elements.size


def states_of(scene: Scene) -> States:
    """Return the states of a specimen's scene, whose supports prescribe them by numbers.

    :class:`InputError` for a scene that is no specimen, or has loads besides pulls.
    """
    if not is_specimen(scene) or scene.prescribed.per_unit:
        raise InputError(f"scene '{scene.name}' is no specimen: its elements share nodes")
    corners = scene.mesh.elements[:, 1:]
    edges = scene.mesh.nodes[corners] - scene.mesh.nodes[scene.mesh.elements[:, :1]]
    if not np.array_equal(edges, np.broadcast_to(np.eye(3), edges.shape)):
        raise InputError(f"scene '{scene.name}' is no specimen: its elements have other corners")
    H = np.swapaxes(scene.held_displacement[corners], 1, 2)
    free = ~np.stack([scene.held[corners[:, k], k] for k in range(3)], axis=1)
    owner = np.repeat(np.arange(len(corners)), 4)
    order = np.argsort(scene.mesh.elements.ravel())
    of_node = owner[order]
    tests = {
        name: np.unique(of_node[nodes])
        for name, nodes in scene.mesh.node_sets.items()
        if not name.startswith(_CORNER)
    }
    return States(H, free, _pulls(scene, corners, free), tests or {"": np.arange(len(corners))})


def _pulls(scene: Scene, corners: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the pulls (m, 3) in kPa: known dead forces on free corners (m, 3) along their axes."""
    forces, pulls = np.zeros(scene.mesh.nodes.shape), np.zeros(free.shape)
    for load in scene.loads:
        own = load.dead_forces(scene.discretisation)
        forces += own.get(None, 0.0)
        pulls = np.where(free, forces[corners, range(3)], 0.0) / _VOLUME
        if own.keys() != {None} or np.count_nonzero(forces) > np.count_nonzero(pulls):
            raise InputError(f"scene '{scene.name}': a specimen has no loads but pulls")
    return pulls


def measured_states(scene: Scene) -> States:
    """Return a state for each measured one: of a tube, that of the innermost point of the wall.

    :class:`InputError` for a scene that is no specimen.
    """
    H, free, pulls, tests = states_of(scene)
    each = 1 if scene.tube is None else scene.tube.size
    measured = {name: rows[::each] // each for name, rows in tests.items()}
    return States(H[::each], free[::each], pulls[::each], measured)
