r"""Data that differ from place to place: tissue directions, regions of different stiffness.

In region k of a scene that has regions, the law's energy is multiplied by the factor :math:`s_k`,

.. math::
    W = s_k\, W_\text{shape} + U(J),

its volumetric part excepted: a soft region is as nearly incompressible as a stiff one. Energies are
proportional to their ``shape_moduli``, so the factor multiplies these.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.mesh import frozen_array
from emulator.mechanics.laws.law import Law, Quantity, number


class Tissue(NamedTuple):
    """Material data of one point, or stacked over elements and their points, axes (m, q).

    directions : fibre (3,), or fibre and sheet (2, 3); None without fibres.
    region : index of its region among the factors, (); None without regions.
    """

    directions: jax.Array | None = None
    region: jax.Array | None = None


def tissue_of(
    fibres: np.ndarray | None, sheets: np.ndarray | None, regions: np.ndarray | None, points: int
) -> Tissue:
    """Material data stacked over elements and their ``points``, leading axes (m, q).

    Parameters
    ----------
    fibres, sheets : (m, q, 3), or None. regions : (m,) labels, or None.
    """
    directions, region = fibres, None
    if fibres is not None and sheets is not None:
        directions = np.stack([fibres, sheets], axis=2)
    if regions is not None:
        index = np.unique(regions, return_inverse=True)[1][:, None]
        region = np.broadcast_to(index, (len(index), points))
    # NumPy arrays: JAX arrays made inside jit would be tracers, and a scene keeps these.
    return Tissue(cast(Any, directions), cast(Any, region))


def factors(regions: np.ndarray | None, values: Mapping[str, Any]) -> jax.Array | None:
    """Stiffness factor (k,) of each region, by ascending label; None without regions."""
    if regions is None:
        return None
    return jnp.stack([jnp.asarray(values[q.name]) for q in region_quantities(regions)])


def region_quantities(regions: np.ndarray) -> tuple[Quantity, ...]:
    """Stiffness factors of ``regions`` (m,), by ascending label: ``stiffness_1`` and so on."""
    return tuple(number(f"stiffness_{label}") for label in np.unique(regions).tolist())


def checked_regions(regions: object, elements: int, law: Law) -> np.ndarray:
    """Read-only labels (m,); :class:`InputError` if invalid, or if the law cannot be scaled."""
    labels = np.asarray(regions)
    if labels.dtype.kind not in "iu":
        raise InputError(f"regions are of type {labels.dtype}; expected whole numbers")
    if labels.shape != (elements,):
        raise InputError(f"regions have shape {labels.shape}; expected ({elements},)")
    if labels.min() < 0:
        raise InputError(f"regions go down to {labels.min()}; expected labels from 0 up")
    if not law.shape_moduli:
        raise InputError(
            f"law '{law.name}' says no shape_moduli, so regions cannot scale it apart from its "
            "resistance to volume change"
        )
    return frozen_array(labels, int)
