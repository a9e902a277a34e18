"""Shape functions and quadrature of a mesh, tabulated once from scikit-fem."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from skfem import Basis, ElementTetP1

from emulator.geometry.mesh import Mesh, frozen_array


@dataclass(frozen=True, eq=False)
class Discretisation:
    """Arrays an energy needs; ``m`` elements, ``q`` quadrature points, ``a`` local nodes.

    connectivity : (m, a) node of each local shape function.
    gradients : (m, q, a, 3) reference gradients of the shape functions, 1/mm.
    values : (q, a) shape functions at the quadrature points.
    weights : (m, q) quadrature weights times volume, mm3.
    """

    connectivity: np.ndarray
    gradients: np.ndarray
    values: np.ndarray
    weights: np.ndarray


def linear_tetrahedra(mesh: Mesh) -> Discretisation:
    """P1 elements with one quadrature point, exact for their constant gradient."""
    basis = Basis(mesh.to_skfem(), ElementTetP1(), intorder=1)
    gradients = np.stack([shape[0].grad for shape in basis.basis])  # (a, 3, m, q)
    values = np.stack([np.asarray(shape[0])[0] for shape in basis.basis])  # (a, q)
    return Discretisation(
        connectivity=frozen_array(basis.element_dofs.T, np.int64),
        gradients=frozen_array(gradients.transpose(2, 3, 0, 1)),
        values=frozen_array(values.T),
        weights=frozen_array(basis.dx),
    )
