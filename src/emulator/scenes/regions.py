r"""What the law may know of each element: its directions, and the region it lies in.

In region k of a scene that has regions, the law's energy is multiplied by a factor of its own,

.. math::
    W = s_k\, W_\text{shape} + U(J),

its volumetric part excepted: a soft region is as nearly incompressible as a stiff one. Energies are
proportional to their ``shape_moduli``, so it is these that the factor multiplies.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.geometry.mesh import frozen_array
from emulator.mechanics.laws.law import Law
from emulator.mechanics.quantity import Quantity, number

if TYPE_CHECKING:
    from emulator.scenes.scene import Scene


class Tissue(NamedTuple):
    """Of one element, or of all with a leading axis m; what a scene does not have is ``None``.

    directions : as in a ``Strain``, (3,) or (2, 3).
    region : place of its region in the factors, ().
    """

    directions: jax.Array | None = None
    region: jax.Array | None = None


def tissue(scene: Scene) -> Tissue:
    """That of every element of a scene."""
    directions = None if scene.directions is None else jnp.asarray(scene.directions)
    if scene.regions is None:
        return Tissue(directions)
    return Tissue(directions, jnp.asarray(np.unique(scene.regions, return_inverse=True)[1]))


def factors(scene: Scene, values: Mapping[str, Any]) -> jax.Array | None:
    """Stiffness factor (k,) of each region, by ascending label; ``None`` without regions."""
    if scene.regions is None:
        return None
    return jnp.stack([jnp.asarray(values[q.name]) for q in region_quantities(scene.regions)])


def region_quantities(regions: np.ndarray) -> tuple[Quantity, ...]:
    """The factors regions (m,) ask for, by ascending label: ``stiffness_1`` and so on."""
    return tuple(number(f"stiffness_{label}") for label in np.unique(regions).tolist())


def checked_regions(regions: object, elements: int, law: Law) -> np.ndarray:
    """Labels (m,), frozen; :class:`InputError` if they are none, or the law cannot be scaled."""
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
