r"""What all observations of Green-Lagrange strain share.

With the unit vector :math:`e` of the reference body and the derivative :math:`d` of the
displacement along it,

.. math::
    E_{ee} = e \cdot E\, e = \tfrac12 (|F e|^2 - 1) = e \cdot d + \tfrac12\, d \cdot d,
    \qquad d = \frac{\partial u}{\partial X}\, e = \sum_a (\nabla N_a \cdot e)\, u_a ,

because :math:`F e = e + d` (Holzapfel 2000, Equation 2.69). The sum is over the nodes of the
element, so an observed strain is a gather of a few nodes; rotations leave no strain.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.local_basis import COMPONENTS
from calibrate.measurements.points import check_values
from calibrate.noise.gaussian import GaussianNoise
from emulator.core.errors import InputError

_CRUSHED = -0.5  # a stretch of 0


@dataclass(frozen=True, eq=False)
class Samples:
    """Strain components at material points, as a function of nodal displacements.

    nodes : (k,) of the mesh, each once.
    members : (s, a) positions in ``nodes`` of each point's element.
    slopes : (s, c, a) derivatives of its shape functions along each direction, 1/mm.
    directions : (s, c, 3) unit vectors.
    """

    nodes: np.ndarray
    members: np.ndarray
    slopes: np.ndarray
    directions: np.ndarray

    @classmethod
    def of(cls, elements: np.ndarray, gradients: np.ndarray, directions: np.ndarray) -> Self:
        """Points in elements with nodes ``elements`` (s, a); ``gradients`` (s, a, 3) in 1/mm."""
        nodes, position = np.unique(elements, return_inverse=True)
        slopes = np.einsum("sai,sci->sca", gradients, directions)
        return cls(nodes, position.reshape(elements.shape), slopes, directions)

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """Strains (..., s, c) from the displacement (..., k, 3) mm of ``nodes``."""
        # Points come last, so that the loops over them are vectorised.
        u = jnp.moveaxis(displacement, -1, -2)[..., self.members.T]  # (..., 3, a, s)
        slopes = np.moveaxis(self.slopes, 0, -1)[:, None]  # (c, 1, a, s)
        directions = np.moveaxis(self.directions, 0, -1)  # (c, 3, s)
        along = jnp.sum(slopes * u[..., None, :, :, :], axis=-2)  # (..., c, 3, s)
        return jnp.moveaxis(jnp.sum((directions + 0.5 * along) * along, axis=-2), -1, -2)


class Strains:
    """Strains (d, c) of ``components`` (c) at d places."""

    components: tuple[str, ...]

    quantity: ClassVar[str] = "strain"
    unit: ClassVar[str] = "1"
    other_units: ClassVar[Mapping[str, float]] = {"%": 0.01}
    default_noise: ClassVar[GaussianNoise] = GaussianNoise(sd=0.02)

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """(d, c)."""

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` unless ``values`` is (d, c), each possible or missing."""
        check_values(name, values, self.shape, self.unit)
        if (values <= _CRUSHED).any():
            raise InputError(
                f"data: {name} goes down to {np.nanmin(values):.3g}; a Green-Lagrange strain is "
                f"above {_CRUSHED}, where nothing is left of a length"
            )


def columns_of(components: Sequence[str], prefix: str = "") -> tuple[str, ...]:
    """Names in files of the strains along ``components``."""
    return tuple(prefix + COMPONENTS[name] for name in components)


def components_in(words: Sequence[str], prefix: str = "") -> tuple[str, ...]:
    """Components whose columns are among ``words``, in the order of the basis."""
    return tuple(name for name in COMPONENTS if prefix + COMPONENTS[name] in words)
