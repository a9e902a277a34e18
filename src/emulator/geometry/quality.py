r"""How well shaped the elements of a mesh are.

The dihedral angle between two faces with outward normals :math:`n_i, n_j` is
:math:`\pi - \arccos(n_i \cdot n_j)`, 70.5 degrees in a regular tetrahedron. Small ones make the
stiffness matrix ill-conditioned, large ones (near 180) make gradients wrong: flat elements have
both. A curved element's Jacobian varies; where it nearly vanishes, the element nearly folds.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from emulator.geometry.discretisation import discretise
from emulator.geometry.mesh import FACES, Mesh, parts

FLAT = 3.0
"""Degrees; elements with a smaller dihedral angle are worth a word."""


class MeshQuality(NamedTuple):
    """Shapes of a mesh's elements.

    parts : the number of disconnected parts.
    angle : the least dihedral angle, degrees. flat : the number of elements below :data:`FLAT`.
    place : mm, middle of the element with the smallest angle.
    jacobian : least ratio of an element's smallest Jacobian to its mean, at quadrature points; 1
        where elements are straight.
    """

    parts: int
    angle: float
    flat: int
    place: tuple[float, float, float]
    jacobian: float

    def sentence(self) -> str:
        """Return all numbers of the quality in one line."""
        place = ", ".join(f"{x:.4g}" for x in self.place)
        pieces = "1 part" if self.parts == 1 else f"{self.parts} parts"
        text = f"{pieces}; smallest dihedral angle {self.angle:.3g} degrees, at ({place})"
        if self.flat:
            text += f", {self.flat} element{'s' * (self.flat > 1)} below {FLAT:g}: remesh there"
        if self.jacobian < 1.0:
            text += f"; least Jacobian {self.jacobian:.2f} of its element's mean"
        return text


def mesh_quality(mesh: Mesh) -> MeshQuality:
    """Return the quality of a mesh from its corners and, where curved, its quadrature points."""
    angles = dihedral_angles(mesh)
    smallest = angles.min(axis=1)
    worst = int(np.argmin(smallest))
    weights = discretise(mesh).weights
    ratio = float((weights.min(axis=1) / weights.mean(axis=1)).min())
    return MeshQuality(
        parts=int(parts(mesh.elements, len(mesh.nodes)).max()) + 1,
        angle=float(smallest[worst]),
        flat=int((smallest < FLAT).sum()),
        place=tuple(mesh.nodes[mesh.elements[worst, :4]].mean(axis=0).tolist()),
        jacobian=min(round(ratio, 12), 1.0),
    )


def dihedral_angles(mesh: Mesh) -> np.ndarray:
    """Return the six dihedral angles of each element, by its corners, (m, 6) degrees."""
    corners = mesh.nodes[mesh.elements[:, :4]]
    normals = []
    for a, b, c in FACES:
        normal = np.cross(corners[:, b] - corners[:, a], corners[:, c] - corners[:, a])
        normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    cosines = [np.einsum("mi,mi->m", one, other) for one, other in combinations(normals, 2)]
    return 180.0 - np.degrees(np.arccos(np.clip(np.stack(cosines, axis=1), -1.0, 1.0)))
