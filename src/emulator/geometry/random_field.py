r"""A smooth random field over part of a body, as modes with independent standard normal sizes.

The field :math:`f` of a Matérn covariance solves

.. math:: (\kappa^2 - \Delta)\, f = c\, \mathcal W, \qquad \partial_n f = 0

with white noise :math:`\mathcal W` (Lindgren, Rue and Lindström 2011, J. R. Stat. Soc. B 73), which
needs no distance through what is not tissue. In the eigenfunctions of the Laplacian,
:math:`-\Delta \psi_j = \lambda_j \psi_j` with :math:`\int \psi_i \psi_j = \delta_{ij}`,

.. math:: f = \sum_j \varphi_j z_j, \qquad \varphi_j = \frac{c}{\kappa^2 + \lambda_j}\, \psi_j,
          \qquad z_j \sim N(0, 1) .

Few modes carry nearly all: of a sheet the share that j modes lack falls as :math:`1/j`. c makes
the variance of the modes that are kept 1 in the mean over the part. In a sheet, where the field is
one of the plane, the correlation at the distance :math:`\sqrt 8/\kappa` is 0.14: that is the length
of the field.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.linalg import eigsh
from skfem import Basis, ElementTetP1, MeshTet
from skfem.models.poisson import laplace, mass

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh, parts

_SHIFT = 1e-3  # of the largest eigenvalue wanted, about: makes the Laplacian's matrix definite


def matern_modes(
    mesh: Mesh, length: float, count: int, within: np.ndarray | None = None
) -> np.ndarray:
    """Return modes (m, count) of a random field of unit variance, in each element of ``mesh``.

    Parameters
    ----------
    mesh : the body.
    length : the distance at which correlation has fallen to 0.14, mm.
    count : the number of modes, the longest waves first, beginning with the constant one.
    within : whether each element lies in the field's part of the body, (m,) bool, where all modes
        are 0 outside; by default everywhere.

    Raises
    ------
    InputError
        A length that is not above 0, or more modes than half of the part's nodes; a part that is
        not connected.
    """
    inside = np.ones(len(mesh.elements), bool) if within is None else np.asarray(within, bool)
    nodes, corners = np.unique(mesh.corners[inside], return_inverse=True)
    corners = corners.reshape(-1, 4)
    if not length > 0.0 or not 1 <= count <= len(nodes) // 2:
        raise InputError(
            f"{count} modes of a field of length {length} mm; give a length above 0 and 1 to "
            f"{len(nodes) // 2} modes, half of the part's {len(nodes)} nodes"
        )
    if pieces := int(parts(corners, len(nodes)).max()):
        raise InputError(f"the field's part of the body has {pieces + 1} pieces; expected one")
    grid = MeshTet(mesh.nodes[nodes].T.copy(), corners.T.copy(), sort_t=False, validate=False)
    basis = Basis(grid, ElementTetP1())
    stiffness, weight = laplace.assemble(basis).tocsc(), mass.assemble(basis).tocsc()
    volume = float(weight.sum())
    kappa = np.sqrt(8.0) / length
    # ARPACK starts at random unless it is told where.
    start = np.cos(np.arange(len(nodes)))
    values, vectors = eigsh(
        stiffness, k=count, M=weight, sigma=-_SHIFT * kappa**2, which="LM", v0=start
    )
    order = np.argsort(values)
    values, vectors = np.maximum(values[order], 0.0), vectors[:, order]
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=0)[None], axis=0)
    amplitudes = 1.0 / (kappa**2 + values)
    # The mean variance is the sum of the squares over the volume, as modes are orthonormal.
    amplitudes *= np.sqrt(volume / np.sum(amplitudes**2))
    modes = np.zeros((len(mesh.elements), count))
    modes[inside] = (vectors * np.sign(largest) * amplitudes)[corners].mean(axis=1)
    return modes
