r"""An emulator of the same body on a coarser mesh, as a part of one on the finer mesh.

.. math:: u(x) = P \Big[ \sum_\text{parts} u_p(x) \Big]

with :math:`P` the prolongation (:mod:`emulator.geometry.refinement`), so that the part is the same
function of position and theta on both meshes. What the coarse mesh gets wrong varies little with
theta, compared with the displacement: a discrepancy model of a few runs on the finer mesh, with
their sensitivities, adds it (recipe ``two_meshes``; two levels of the model of Kennedy and O'Hagan
2000, of fields and their slopes), and so does a polynomial of a few sweeps over the box (recipe
``sweeps``, without any FEM run).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_matrix

from emulator.core.errors import InputError
from emulator.core.store import inside
from emulator.scenes.finer import Finer
from emulator.scenes.scene import Scene
from emulator.surrogates.discrepancy import Discrepancy
from emulator.surrogates.part import CachedPart, EmulatorPart, arrays_of, together, widened
from emulator.surrogates.polynomial import Polynomial
from emulator.surrogates.taylor import Expansion

_PARTS: dict[str, type[EmulatorPart]] = {
    "taylor": Expansion,
    "polynomial": Polynomial,
    "discrepancy": Discrepancy,
}


@dataclass(frozen=True, eq=False)
class Coarse:
    """Parts of an emulator on a coarser mesh, interpolated at the nodes of the finer one.

    parts : the parts by name, over the coarse nodes.
    prolongation : the matrix P, (fine nodes, coarse nodes).
    """

    parts: Mapping[str, EmulatorPart]
    prolongation: csr_matrix

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return the displacement (n, 3) mm of the finer mesh's nodes at ``position`` (p,)."""
        cached = self.cache(np.arange(self.prolongation.shape[0]))
        free = jnp.tensordot(cached.coefficients(position), cached.modes, axes=1)
        return jnp.asarray(cached.offset) + free

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """Return the part over ``nodes`` (k,) of the finer mesh."""
        rows = self.prolongation[nodes]
        coarse_nodes = np.unique(rows.indices)
        coarse = [part.cache(coarse_nodes) for part in self.parts.values()]
        cached, carry = together(coarse, len(coarse_nodes)), rows[:, coarse_nodes]
        modes = carry @ cached.modes.transpose(1, 0, 2).reshape(len(coarse_nodes), -1)
        modes = modes.reshape(len(nodes), -1, 3).transpose(1, 0, 2)
        return CachedPart(carry @ cached.offset, modes, cached.coefficients)

    def arrays(self) -> dict[str, Any]:
        """Return the arrays of all parts, as ``taylor/derivatives``, and of the prolongation."""
        names = ("data", "indices", "indptr")
        matrix = {f"prolongation/{name}": getattr(self.prolongation, name) for name in names}
        return arrays_of(self.parts) | matrix

    def to_json(self) -> dict[str, Any]:
        """Return the number of nodes of the coarse mesh, and the JSON of the parts."""
        parts = {name: part.to_json() for name, part in self.parts.items()}
        return {"nodes": self.prolongation.shape[1], "parts": parts}

    @classmethod
    def restore(
        cls, scene: Scene, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> Self:
        """Return the part with this description and these arrays."""
        matrix = inside(arrays, "prolongation")
        shape = len(scene.mesh.nodes), description["nodes"]
        rows = csr_matrix((widened(matrix["data"]), matrix["indices"], matrix["indptr"]), shape)
        parts = {
            name: _PARTS[name].restore(scene, part, inside(arrays, name))
            for name, part in description["parts"].items()
        }
        return cls(parts, rows)


def carried(parts: Mapping[str, EmulatorPart], body: Finer) -> Coarse:
    """Return the ``parts`` of an emulator of ``body.coarse`` on the finer mesh.

    :class:`InputError` for no parts, or one that is no series, polynomial or discrepancy.
    """
    if not parts or not set(parts) <= set(_PARTS):
        raise InputError(
            f"two meshes: the emulator on the coarser mesh is {' + '.join(parts) or 'empty'}; give "
            "one of a series and a discrepancy, or a polynomial, as recipes mechanics and sweeps "
            "make"
        )
    return Coarse(dict(parts), csr_matrix(body.refinement.prolongation))
