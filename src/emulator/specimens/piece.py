r"""Gripped specimens: a box of tissue between the grips of a testing machine.

A homogeneous state (:mod:`emulator.specimens.specimen`) is what the middle of a piece would do far
from its grips. The piece itself is a box, whose faces the machine moves by grip displacements q,

.. math:: u_i = q_{ij} L_j \quad\text{on the upper face normal to } j, \qquad
          u_i = 0 \quad\text{on the lower one},

with the lengths L. A stress is the force on the upper face over its area at rest,
:math:`P_{ij} = R_i / A_j`. Stretches are those between the grips, H = q, or those between marks in
the middle: the mean gradient in a square,

.. math:: H = \frac{1}{|\omega|} \int_\omega \frac{\partial u}{\partial X} \, dX .
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.generators.box import box
from emulator.geometry.mesh import Mesh
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports.dirichlet import Support
from emulator.specimens.grips import Grips
from emulator.specimens.specimen import Specimen
from emulator.specimens.states import AXES, States

_FACES = (("left", "right"), ("front", "back"), ("bottom", "top"))
_MIDDLE, _TIE = "middle", "tie"  # sets of the plane of symmetry, and of what stops rigid motions
_IN_PLANE = 1e-6  # component of a direction across the plane of symmetry that is none
_ROUND_OFF = 1e-12


@dataclass(frozen=True, eq=False)
class Piece:
    """The gripped specimen in the tests that move the same faces.

    Parameters
    ----------
    specimen : its homogeneous states.
    grips : how it was held.
    faces : the axes whose upper face is moved.
    components : the pairs (i, j), each for faces normal to j that are displaced along i.
    largest : the largest absolute value of each of ``components`` in any state.
    """

    specimen: Specimen
    grips: Grips
    faces: tuple[int, ...]
    components: tuple[tuple[int, int], ...]
    largest: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.grips.held == "clamped" and len(self.faces) > 1:
            axes = " and ".join(AXES[j] for j in self.faces)
            raise InputError(
                f"grips: faces clamped along {axes} would tear at their common edges; give held = "
                '"hooks"'
            )

    @property
    def rows(self) -> list[int]:
        """The axes along which faces move, for each of :attr:`components`."""
        return [i for i, _ in self.components]

    @property
    def columns(self) -> list[int]:
        """The axes of the faces that move, likewise."""
        return [j for _, j in self.components]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters that move faces."""
        return tuple(f"grip_{AXES[i]}{AXES[j]}" for i, j in self.components)

    @cached_property
    def thin(self) -> int | None:
        """The axis normal to the plane of symmetry; ``None`` where clamps hold whole faces."""
        if self.grips.held == "clamped":
            return None
        others = [k for k in range(3) if k not in self.faces]
        return min(others, key=lambda k: self.grips.size[k])

    @property
    def upper(self) -> dict[int, str]:
        """The support whose force is measured on each face, by the face's axis."""
        clamped = self.grips.held == "clamped"
        return {j: _FACES[j][1] if clamped else _hooks(_FACES[j][1]) for j in self.faces}

    @property
    def acting(self) -> np.ndarray:
        """The forces i that act on the face normal to j, a mask (3, 3)."""
        on_faces = np.isin(np.arange(3), self.faces)
        return on_faces & (np.eye(3, dtype=bool) | (self.grips.held == "clamped"))

    def area(self, j: int) -> float:
        """Return the area at rest of the face normal to axis j in the mesh, mm2."""
        sides = np.delete(self._lengths, j)
        return float(sides[0] * sides[1])

    @cached_property
    def _lengths(self) -> np.ndarray:
        lengths = np.array(self.grips.size, dtype=float)
        if self.thin is not None:
            lengths[self.thin] *= 0.5
        return lengths

    @cached_property
    def mesh(self) -> Mesh:
        """Quadratic tetrahedra, with the sets that :attr:`scene` holds."""
        lengths, longest = self._lengths, self._lengths.max()
        cells = np.maximum(np.round(self.grips.cells * lengths / longest).astype(int), 1)
        if self.thin is not None:  # hooks are at the ends of elements
            in_plane = np.arange(3) != self.thin
            edge = 2 * self.grips.hooks
            cells[in_plane] = edge * np.maximum(np.round(cells[in_plane] / edge).astype(int), 1)
        mesh = box(tuple(lengths), tuple(cells.tolist()), order=2)
        return replace(mesh, node_sets={**mesh.node_sets, **self._sets(mesh)})

    def _sets(self, mesh: Mesh) -> dict[str, np.ndarray]:
        """Return the hooks of each face, the plane of symmetry, and a line that stops motions."""
        if (thin := self.thin) is None:
            return {}
        sets, lengths, near = dict[str, np.ndarray](), self._lengths, 1e-6 * self._lengths.max()
        sets[_MIDDLE] = np.flatnonzero(mesh.nodes[:, thin] < near)
        for j in self.faces:
            (along,) = {0, 1, 2} - {j, thin}
            places = lengths[along] * (np.arange(self.grips.hooks) + 0.5) / self.grips.hooks
            for face in _FACES[j]:
                nodes = mesh.node_sets[face]
                apart = np.abs(mesh.nodes[nodes, along][:, None] - places)
                sets[_hooks(face)] = nodes[(apart < near).any(axis=1)]
                central = apart[:, self.grips.hooks // 2] < near
                sets.setdefault(_TIE, nodes[central])
        return sets

    @cached_property
    def scene(self) -> Scene:
        """The piece as a scene, whose further parameters move the faces."""
        specimen, size = self.specimen, self.grips.size
        supports = list[Support]()
        clamped = self.grips.held == "clamped"
        for j, upper in self.upper.items():
            lower = _FACES[j][0] if clamped else _hooks(_FACES[j][0])
            held = AXES if clamped else AXES[j]
            supports.append(Support(lower, components=held))
            amounts = {
                i: name for (i, k), name in zip(self.components, self.names, strict=True) if k == j
            }
            for i, name in amounts.items():
                supports.append(Support(upper, size[j] * np.eye(3)[i], AXES[i], amount=name))
            still = "".join(a for i, a in enumerate(AXES) if a in held and i not in amounts)
            if still:
                supports.append(Support(upper, components=still))
        if self.thin is not None:
            supports.append(Support(_MIDDLE, components=AXES[self.thin]))
            loose = {0, 1, 2} - {self.thin, *self.faces}
            supports += [Support(_TIE, components=AXES[k]) for k in loose]
        ranges = (
            Parameter(name, "", -2.0 * most - 0.01, 2.0 * most + 0.01)
            for name, most in zip(self.names, self.largest, strict=True)
        )
        return Scene(
            name=f"gripped {specimen.name}",
            mesh=self.mesh,
            law=specimen.law,
            parameters=(*specimen.parameters, *ranges),
            supports=tuple(supports),
            constants=specimen.constants,
            dilatation="mean",
            **self._directions(),
        )

    def _directions(self) -> dict[str, Any]:
        """Return the fibres and sheets of the specimen, which are the same in all its states."""
        entries = dict[str, Any]()
        rule = self.specimen.fibre_rule
        if self.specimen.angles:
            if rule is None:
                raise InputError("grips: fibre angles without the rule that made them")
            entries |= {"fibre_rule": rule, "angles": rule.angles_in(self.mesh)}
        for name in ("fibres", "sheets"):
            directions = getattr(self.specimen, name)
            if directions is None:
                continue
            vectors = directions.reshape(-1, 3)
            if np.ptp(vectors, axis=0).max() > _IN_PLANE:
                raise InputError(
                    f"grips: {name} differ between states; one piece has one direction"
                )
            across = 0.0 if self.thin is None else abs(vectors[0, self.thin])
            if min(across, 1.0 - across) > _IN_PLANE:
                plane = AXES.replace(AXES[self.thin or 0], "")
                raise InputError(
                    f"grips: {name} are inclined to the {plane} plane of the hooks, which is then "
                    "no plane of symmetry"
                )
            entries[name] = np.broadcast_to(vectors[0], (len(self.mesh.elements), 3))
        return entries

    def between_marks(self, u: np.ndarray) -> np.ndarray:
        """Return the gradient between the marks at :attr:`components`, (q,).

        u : the displacement (n, 3) mm.
        """
        return (u.T @ self._mean_gradient)[self.rows, self.columns]

    @cached_property
    def _mean_gradient(self) -> np.ndarray:
        """The functional G (n, 3) for which u^T G is the gradient H (3, 3) between the marks."""
        marks = self.grips.marks
        assert marks is not None
        of = self.scene.discretisation
        centres = self.mesh.nodes[of.connectivity].mean(axis=1)
        middle = 0.5 * self._lengths
        apart = np.abs(centres - middle)
        if self.thin is not None:
            apart[:, self.thin] = 0.0
        inside = apart.max(axis=1) <= max(0.5 * marks, apart.max(axis=1).min() + _ROUND_OFF)
        weighted = of.weights[inside, :, None, None] * of.gradients[inside]
        G = np.zeros((len(self.mesh.nodes), 3))
        np.add.at(G, of.connectivity[inside], weighted.sum(axis=1))
        return G / of.weights[inside].sum()


def _hooks(face: str) -> str:
    return f"{face}.hooks"


def pieces(specimen: Specimen) -> dict[str, Piece]:
    """Return the gripped piece of each test of a specimen with grips, by the test's name.

    Tests that move the same faces in the same way have one piece.

    Raises
    ------
    InputError
        A test that moves no face, faces that cannot be clamped at
        once, or directions that the piece cannot have.
    """
    states, grips = specimen.states, specimen.grips
    assert grips is not None
    faces = {name: _faces(states, rows, grips) for name, rows in states.protocols.items()}
    by_pattern = dict[Any, Piece]()
    for pattern in dict.fromkeys(faces.values()):
        axes, components = pattern
        tests = [rows for name, rows in states.protocols.items() if faces[name] == pattern]
        H = np.abs(states.gradients[np.concatenate(tests)])
        largest = tuple(float(H[:, i, j].max()) for i, j in components)
        by_pattern[pattern] = Piece(specimen, grips, axes, components, largest)
    return {name: by_pattern[pattern] for name, pattern in faces.items()}


def _faces(
    states: States, rows: Sequence[int] | np.ndarray, grips: Grips
) -> tuple[tuple[int, ...], tuple[tuple[int, int], ...]]:
    """Return the axes whose faces a test moves, and the components (i, j) of the displacements."""
    H, free = states.gradients[rows], states.free[rows].any(axis=0)
    moves = np.abs(H).max(axis=0) > _ROUND_OFF
    sheared = [j for j in range(3) if moves[:, j].sum() - moves[j, j] > 0]
    if sheared and grips.held == "hooks":
        raise InputError("grips: hooks do not shear a piece; plates do, held = clamped")
    # A stretch that stays 1 is one that hooks hold, or that the width of a clamped piece keeps.
    driven = [j for j in range(3) if not free[j] and (moves[j, j] or grips.held == "hooks")]
    axes = tuple(sheared or driven)
    if not axes:
        raise InputError("grips: a test moves no face of the piece")
    if len(axes) == 3:
        raise InputError("grips: a test holds the stretches along x, y and z; hooks hold two")
    components = tuple(
        (i, j)
        for j in axes
        for i in range(3)
        if (moves[i, j] if i != j else not free[j] and (moves[j, j] or grips.held == "hooks"))
    )
    return axes, components
