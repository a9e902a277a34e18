"""Several bodies as one mesh of disjoint parts.

A scene of such a mesh has one law and one theta: bodies of one material, each with its own loads,
supports and observations. They share no node and do not feel each other, wherever they are.

Sets are called ``body.set``, and the whole surface of a body is the facet set and the node set
``body``. The dot has no meaning in words that say what is observed, where ``:`` ends a name
(``reaction:SUPPORT:AXIS``), nor in the names of files' variables, where ``/`` has one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from emulator.core.errors import InputError, check_known
from emulator.geometry.mesh import Mesh, coincident, frozen_array

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")


@dataclass(frozen=True, eq=False)
class Bodies:
    """Bodies in one mesh. :func:`side_by_side` makes it.

    Parameters
    ----------
    mesh : the mesh of all bodies; elements and nodes in the bodies' order.
    names : the names of the bodies.
    body : the index (m,) of each element's body.
    """

    mesh: Mesh
    names: tuple[str, ...]
    body: np.ndarray

    def elements(self, name: str) -> np.ndarray:
        """Return the elements (k,) of body ``name``; :class:`InputError` lists the bodies."""
        check_known(name, self.names, "body")
        return np.flatnonzero(self.body == self.names.index(name))

    def nodes(self, name: str) -> np.ndarray:
        """Return all nodes (k,) of body ``name``, in its own order."""
        return np.unique(self.mesh.elements[self.elements(name)])

    def stacked(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return values (m, ...) at the mesh's elements from those of each body, by its name.

        Fibres and sheets (k, 3) or (k, q, 3), or regions (k,).

        Raises
        ------
        InputError
            A body without values, or with values of another shape or number of elements.
        """
        parts: list[np.ndarray] = []
        for name, count in zip(self.names, np.bincount(self.body), strict=True):
            if name not in values:
                raise InputError(f"bodies: no values for '{name}'; give one array for each")
            part = np.asarray(values[name])
            if len(part) != count or (parts and part.shape[1:] != parts[0].shape[1:]):
                others = f" and {parts[0].shape[1:]} for '{self.names[0]}'" if parts else ""
                problem = f"bodies: values of '{name}' have shape {part.shape}"
                raise InputError(f"{problem}; it has {count} elements{others}")
            parts.append(part)
        return np.concatenate(parts)


def side_by_side(meshes: Mapping[str, Mesh], *, gap: float | None = None) -> Bodies:
    """Return ``meshes`` as one; a body's set ``top`` becomes ``body.top``.

    Parameters
    ----------
    gap : mm between one body and the next along x; ``None`` leaves them where they are. A body that
        is moved is moved along x only: a plane of symmetry x = 0 is no longer there.

    Raises
    ------
    InputError
        No bodies, a name that is none, bodies of different orders, a gap that is not above 0, or
        bodies with nodes at the same place.
    """
    if not meshes:
        raise InputError("bodies: give one mesh or more, by name")
    if gap is not None and not 0.0 < gap < np.inf:
        raise InputError(f"bodies: gap is {gap} mm; it must be above 0, or None to move none")
    (first, order), *orders = ((name, mesh.order) for name, mesh in meshes.items())
    for name, other in orders:
        if other != order:
            raise InputError(
                f"bodies: '{first}' has tetrahedra of order {order} and '{name}' of order {other}; "
                "make all linear, or all quadratic"
            )
    for name in meshes:
        check_name(name)
    names, placed = tuple(meshes), [*meshes.values()]
    if gap is not None:
        for k, mesh in enumerate(placed[1:], 1):
            beyond = placed[k - 1].nodes[:, 0].max() + gap - mesh.nodes[:, 0].min()
            placed[k] = shifted(mesh, (beyond, 0.0, 0.0))
    nodes = np.concatenate([mesh.nodes for mesh in placed])
    owner = np.repeat(np.arange(len(names)), [len(mesh.nodes) for mesh in placed])
    pairs = coincident(nodes)
    pairs = pairs[owner[pairs[:, 0]] != owner[pairs[:, 1]]]
    if len(pairs):
        one, other = np.sort(owner[pairs[0]])
        raise InputError(
            f"bodies: '{names[one]}' and '{names[other]}' have {len(pairs)} nodes at the same "
            "places, where it is not clear whose a support is; move one of them"
        )
    elements: list[np.ndarray] = []
    node_sets: dict[str, np.ndarray] = {}
    facet_sets: dict[str, np.ndarray] = {}
    start = 0
    for name, mesh in zip(names, placed, strict=True):
        elements.append(mesh.elements + start)
        facet_sets[name] = mesh.surface + start
        node_sets[name] = np.unique(facet_sets[name])
        node_sets |= {f"{name}.{of}": rows + start for of, rows in mesh.node_sets.items()}
        facet_sets |= {f"{name}.{of}": rows + start for of, rows in mesh.facet_sets.items()}
        start += len(mesh.nodes)
    body = np.repeat(np.arange(len(names)), [len(part) for part in elements])
    mesh = Mesh(nodes, np.concatenate(elements), node_sets, facet_sets)
    return Bodies(mesh, names, frozen_array(body, np.int64))


def shifted(mesh: Mesh, shift: tuple[float, float, float]) -> Mesh:
    """Return ``mesh`` moved by ``shift`` mm."""
    return replace(mesh, nodes=mesh.nodes + np.asarray(shift))


def check_name(name: str) -> None:
    """Raise :class:`InputError` unless ``name`` can be a body's: letters, digits, _ and -."""
    if not _NAME.fullmatch(name):
        raise InputError(
            f"body '{name}': a name has letters, digits, _ and -, and begins with a letter"
        )
