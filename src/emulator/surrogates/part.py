r"""What an emulator is a sum of.

.. math:: u(x) = \sum_\text{parts} u_p(x), \qquad
    u_p(x) = \bar u_p + \sum_k c_{pk}(x)\, \phi_{pk} + d_p(x)

with :math:`x` theta's position in the unit box. Most parts are an offset and modes; only a network
with a pointwise decoder has a field :math:`d` that is not a sum of modes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self

import jax
import jax.numpy as jnp
import numpy as np

from emulator.scenes.scene import Scene


class Part(Protocol):
    """One term of an emulator's sum."""

    def __call__(self, position: jax.Array) -> jax.Array:
        """Displacement (n, 3) in mm of all nodes at ``position`` (p,) in the unit box."""
        ...

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """The part over ``nodes`` (k,), everything that does not depend on theta evaluated."""
        ...

    def arrays(self) -> Mapping[str, Any]:
        """All arrays the part consists of, by the names a file keeps them under."""
        ...

    def to_json(self) -> dict[str, Any]:
        """All else the part consists of, as plain JSON."""
        ...

    @classmethod
    def restore(
        cls, scene: Scene, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> Self:
        """The part with this :meth:`to_json` and these :meth:`arrays`, in float32 or float64."""
        ...


class OfArrays:
    """What a part is that its arrays are all of: they are its fields."""

    def arrays(self) -> dict[str, Any]:
        """All fields by name."""
        return vars(self).copy()

    def to_json(self) -> dict[str, Any]:
        """Nothing: the arrays are all."""
        return {}


class NodalField(Protocol):
    """Displacement of some nodes as a function of position, not a sum of modes."""

    def __call__(self, position: jax.Array) -> jax.Array:
        """Displacement (..., k, 3) in mm at ``position`` (..., p)."""
        ...

    def at(self, rows: np.ndarray) -> NodalField:
        """The field over rows of its nodes."""
        ...


@dataclass(frozen=True, eq=False)
class CachedPart:
    """A part over k nodes.

    offset : (k, 3) mm. modes : (t, k, 3) mm. Both NumPy's: a JAX array made during somebody's
        trace would belong to that trace.
    coefficients : position (p,) to the coefficients (t,) of the modes.
    field : what is not a sum of modes, or None.
    """

    offset: np.ndarray
    modes: np.ndarray
    coefficients: Callable[[jax.Array], jax.Array]
    field: NodalField | None = None

    def at(self, rows: np.ndarray) -> CachedPart:
        """The part over rows of its nodes."""
        field = None if self.field is None else self.field.at(rows)
        return replace(self, offset=self.offset[rows], modes=self.modes[:, rows], field=field)


def no_modes(nodes: np.ndarray, field: NodalField) -> CachedPart:
    """A part that is nothing but ``field`` over ``nodes`` (k,)."""
    count = len(nodes)
    return CachedPart(np.zeros((count, 3)), np.zeros((0, count, 3)), lambda _: jnp.zeros(0), field)


def widened(array: np.ndarray) -> np.ndarray:
    """Floating point numbers in float64; a file may keep them in float32."""
    return array.astype(np.float64) if np.issubdtype(array.dtype, np.floating) else array
