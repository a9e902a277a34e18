r"""The parts that an emulator is the sum of.

.. math:: u(x) = \sum_\text{parts} u_p(x), \qquad
    u_p(x) = \bar u_p + \sum_k c_{pk}(x)\, \phi_{pk} + d_p(x)

with :math:`x` theta's position in the unit box. Most parts are an offset and modes; only a network
with a pointwise decoder has a field :math:`d` that is not a sum of modes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol, Self, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.store import inside, named_leaves
from emulator.scenes.scene import Scene


class EmulatorPart(Protocol):
    """One term of an emulator's sum."""

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return the displacement (n, 3) mm of all nodes at ``position`` (p,) in the unit box."""
        ...

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """Return the part over ``nodes`` (k,), all evaluated that does not depend on theta."""
        ...

    def arrays(self) -> Mapping[str, Any]:
        """Return all arrays of the part by their names in a file."""
        ...

    def to_json(self) -> dict[str, Any]:
        """Return all else that the part consists of, as plain JSON."""
        ...

    @classmethod
    def restore(
        cls, scene: Scene, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> Self:
        """Return the part of this :meth:`to_json` and these :meth:`arrays`, float32 or float64."""
        ...


def arrays_of(parts: Mapping[str, EmulatorPart]) -> dict[str, Any]:
    """Return the arrays of parts by name, such as ``taylor/derivatives``."""
    return {f"{n}/{k}": array for n, part in parts.items() for k, array in part.arrays().items()}


class ArrayPart:
    """A part whose fields are all arrays, or named tuples of arrays; files keep all of them.

    A dataclass that inherits from this class has its arrays written and read by their names; those
    of a named tuple ``warp`` are called ``warp/centre`` and so on.
    """

    def arrays(self) -> dict[str, Any]:
        """Return all arrays by name."""
        values = ((field.name, getattr(self, field.name)) for field in fields(self))  # type: ignore[arg-type]
        return named_leaves({n: v._asdict() if hasattr(v, "_asdict") else v for n, v in values})

    def to_json(self) -> dict[str, Any]:
        """Return nothing: the arrays are all."""
        return {}

    @classmethod
    def restore(
        cls, scene: Scene, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> Self:
        """Return the part with these arrays."""
        del scene, description
        return _fill(cls, arrays)


def _fill(kind: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Return the dataclass or named tuple ``kind`` with its fields taken from ``arrays``."""
    values: dict[str, Any] = {}
    for name, hint in get_type_hints(kind).items():
        if hint is np.ndarray:
            values[name] = widened(arrays[name])
        elif hint is jax.Array:
            values[name] = jnp.asarray(widened(arrays[name]))
        else:
            values[name] = _fill(hint, inside(arrays, name))
    return kind(**values)


@dataclass(frozen=True, eq=False)
class CachedPart:
    """A part over k nodes.

    offset, modes : (k, 3) mm and (t, k, 3) mm. They are NumPy's, because a JAX array that is made
        while a caller is traced would belong to that trace.
    coefficients : the function from position (p,) to the coefficients (t,) of the modes.
    prepared, decode : for a field that is not a sum of modes, all of it that does not depend on
        theta, (c, k, h), and the function from that and a position (..., p) to (..., k, 3) mm.
    """

    offset: np.ndarray
    modes: np.ndarray
    coefficients: Callable[[jax.Array], jax.Array]
    prepared: jax.Array | None = None
    decode: Callable[[jax.Array, jax.Array], jax.Array] | None = None

    def at(self, rows: np.ndarray) -> CachedPart:
        """Return the part over some rows of its nodes."""
        prepared = None if self.prepared is None else self.prepared[:, rows]
        return replace(self, offset=self.offset[rows], modes=self.modes[:, rows], prepared=prepared)


def together(parts: Sequence[CachedPart], count: int) -> CachedPart:
    """Add ``parts`` over ``count`` nodes; at most one of them may predict a second field."""
    nothing = CachedPart(np.zeros((count, 3)), np.zeros((0, count, 3)), lambda _: jnp.zeros(0))
    terms = [nothing, *parts]
    other = next((part for part in parts if part.decode is not None), nothing)
    return replace(
        other,
        offset=sum((part.offset for part in parts), nothing.offset),
        modes=np.concatenate([part.modes for part in terms]),
        coefficients=lambda x: jnp.concatenate([part.coefficients(x) for part in terms]),
    )


def widened(array: np.ndarray) -> np.ndarray:
    """Return floating point numbers in float64; a file may keep them in float32."""
    return array.astype(np.float64) if np.issubdtype(array.dtype, np.floating) else array
