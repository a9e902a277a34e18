r"""The volume of a cavity in mL, from the displacement of its wall's own nodes.

The wall is a facet set; a flat lid, a fan of facets from the middle of the rim, closes each of its
openings. By the divergence theorem the closed surface encloses

.. math::
    V = \frac13 \int_\Omega \nabla \cdot x \, dv = \frac13 \oint x \cdot n \, da
      = \sum_\text{facets} \frac16\, x_1 \cdot (x_2 \times x_3),

the sum for linear facets; quadratic ones are integrated exactly. A closed surface has
:math:`\oint n\, da = 0`, so the volume does not depend on the origin. Facets of a mesh point out of
the tissue, which may lie on either side of the wall. The sign is therefore chosen once, so that the
volume at rest is positive, and then kept, so that the volume stays differentiable.
"""

from __future__ import annotations

from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.facets import enclosed_volume
from emulator.geometry.mesh import Mesh

MM3_PER_ML = 1000.0
_FLAT = 1e-9  # volumes below this fraction of the mesh's size cubed are round-off: a plane patch


class Cavity:
    """Volume of a cavity as a function of its wall's displacement.

    Parameters
    ----------
    mesh : with the wall among its facet sets.
    facet_set : the wall.

    Attributes
    ----------
    nodes : (k,) the nodes of the wall, in the order :meth:`__call__` wants them.
    rest : volume of the undeformed cavity, mL, above 0.

    Raises
    ------
    InputError
        The set is missing or encloses no volume.
    """

    def __init__(self, mesh: Mesh, facet_set: str) -> None:
        self.facet_set = facet_set
        facets = mesh.facet_set(facet_set)
        self.nodes: np.ndarray = np.unique(facets)
        X = mesh.nodes[self.nodes]
        self._X = X - X.mean(axis=0)  # less cancellation: coordinates about the centroid
        self._volume = enclosed_volume(np.searchsorted(self.nodes, facets))
        signed = float(self._volume(self._X))
        if abs(signed) <= _FLAT * mesh.size**3:
            raise InputError(
                f"facet set '{facet_set}' encloses no volume: it is flat, or has no inside"
            )
        self._factor = float(np.sign(signed)) / MM3_PER_ML

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """Volume (...) in mL where the nodes of the wall move by ``displacement`` (..., k, 3) mm.

        Differentiable; ``displacement[..., cavity.nodes, :]`` restricts a full field.
        """

        def one(u: jax.Array) -> jax.Array:
            return self._factor * self._volume(self._X + u)

        return jnp.vectorize(one, signature="(k,d)->()")(jnp.asarray(displacement))

    @cached_property
    def rest(self) -> float:
        """Volume of the undeformed cavity, mL."""
        return self._factor * float(self._volume(self._X))


def encloses(mesh: Mesh, facet_set: str) -> bool:
    """Whether ``facet_set`` is the wall of a cavity; a plane patch encloses nothing."""
    mesh.facet_set(facet_set)  # a set that is not there is an error
    try:
        Cavity(mesh, facet_set)
    except InputError:
        return False
    return True
