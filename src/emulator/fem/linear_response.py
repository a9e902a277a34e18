r"""How a wall at rest gives to a cavity's pressure, linearised, and how that depends on its moduli.

The strains :math:`\epsilon = \operatorname{sym} \nabla w` are small, and the wall's energy is

.. math::
    \int \mu\, \epsilon : \epsilon + \tfrac{\lambda}{2} (\operatorname{tr} \epsilon)^2
      + 2 a_f\, (f \cdot \epsilon f)^2 \, dX = \tfrac12 w \cdot K w, \qquad
    K = \mu K_\mu + \lambda K_\lambda + a_f K_f ,

:math:`a_f` as in Holzapfel and Ogden's law. The response to 1 kPa and its derivatives in the moduli
take one factorisation:

.. math::
    w = K^{-1} f, \quad \partial w / \partial a_f = -K^{-1} K_f w, \quad
    \partial^2 w / \partial a_f^2 = 2 K^{-1} K_f K^{-1} K_f w, \quad
    \partial w / \partial \lambda = -K^{-1} K_\lambda w .

The moduli are fixed, those of passive myocardium, so that the fields depend on geometry alone. They
tell a network what no message between neighbours can: how the whole body moves.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_matrix

from emulator.core.errors import InputError
from emulator.fem.linear import block_pattern, upper_blocks
from emulator.fem.linear.suitesparse import Outcome, factor_and_solve
from emulator.geometry.discretisation import Discretisation, facet_rule
from emulator.geometry.facets import nodal_area_vectors
from emulator.geometry.mesh import Mesh

MATRIX, FIBRES, BULK = 0.5, 5.6, 25.0
"""The moduli mu, a_f and lambda, kPa."""

RESPONSES = 4
"""The number of fields of :func:`linear_responses`."""


def linear_responses(
    grid: Discretisation, fibres: np.ndarray, cavity: str, held: np.ndarray
) -> np.ndarray:
    """Return w and its derivatives above, up to sign and factor, (4, n, 3).

    grid : the mesh with its shape functions.
    fibres : the unit fibres at the quadrature points, (m, q, 3).
    cavity : the facet set under pressure. held : the displacements that are zero, (n, 3) bool.

    :class:`InputError` where the body is not held enough to resist.
    """
    free = np.flatnonzero(~held.ravel())
    index = np.full(held.size, -1)
    index[free] = np.arange(len(free))
    pattern = block_pattern([upper_blocks(grid.connectivity)], index, symmetric=True)
    blocks = _stiffnesses(grid, fibres)
    one, other = np.triu_indices(grid.connectivity.shape[1])

    def assembled(parts: np.ndarray) -> np.ndarray:
        entries = parts[:, one, :, other].transpose(1, 0, 2, 3).ravel()[pattern.source]
        return np.bincount(pattern.target, entries, minlength=len(pattern.rows))

    def times(part: np.ndarray, x: np.ndarray) -> np.ndarray:
        above = csr_matrix((part, (pattern.rows, pattern.columns)), (len(free), len(free)))
        return above @ x + above.T @ x - above.diagonal() * x

    matrix, bulk, along = (assembled(part) for part in blocks)
    values = jnp.asarray(MATRIX * matrix + BULK * bulk + FIBRES * along)

    def solved(force: np.ndarray) -> np.ndarray:
        x, outcome = factor_and_solve(pattern, values, jnp.asarray(force), "definite")
        if int(outcome) != Outcome.OK:
            raise InputError("its supports leave it free to move")
        return np.asarray(x)

    w = solved(pressure_force(grid.mesh, grid.mesh.nodes, cavity).ravel()[free])
    stiffer = solved(times(along, w))
    fields = np.zeros((RESPONSES, held.size))
    fields[:, free] = [w, stiffer, solved(times(along, stiffer)), solved(times(bulk, w))]
    return fields.reshape(RESPONSES, -1, 3)


def pressure_force(mesh: Mesh, places: np.ndarray, cavity: str) -> np.ndarray:
    """Return the nodal forces (n, 3) in mN of 1 kPa on the facet set ``cavity``.

    places : where the nodes are, (n, 3) mm. In mm2, they are the derivatives of the cavity's volume
        by the places too, where its rim is held.
    """
    facets = mesh.facet_set(cavity)
    force = np.zeros(places.shape)
    areas = nodal_area_vectors(places[facets], facet_rule(mesh.order, 2 * mesh.order))
    np.add.at(force, facets, -areas)
    return force


def _stiffnesses(grid: Discretisation, fibres: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the elements' parts of K for unit mu, lambda and a_f, each (m, a, 3, a, 3)."""
    gradients, weights = grid.gradients, grid.weights
    count, points, nodes, _ = gradients.shape

    def products(vectors: np.ndarray) -> np.ndarray:
        """Return the integrals of ``vectors`` (m, q, a, 3) times themselves."""
        flat = vectors.reshape(count, points, -1)
        blocks = np.swapaxes(flat * weights[..., None], 1, 2) @ flat
        return blocks.reshape(count, nodes, 3, nodes, 3)

    bulk = products(gradients)
    trace = np.einsum("maibi->mab", bulk)
    matrix = trace[:, :, None, :, None] * np.eye(3)[:, None] + bulk.transpose(0, 1, 4, 3, 2)
    stretch = np.einsum("mqi,mqai->mqa", fibres, gradients)
    along = products(stretch[..., None] * fibres[:, :, None])
    return matrix, bulk, 4.0 * along
