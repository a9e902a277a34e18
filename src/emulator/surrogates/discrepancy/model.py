r"""A fitted discrepancy model: modes with Gaussian processes as coefficients.

.. math:: e(x) = \bar e + \sum_k c_k(x)\, \phi_k

with :math:`x` theta's position in the unit box and :math:`c_k` the posterior mean of a Gaussian
process of values and derivatives (:mod:`emulator.core.gaussian_process`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.gaussian_process import Features, mean
from emulator.core.precision import require_float64
from emulator.core.store import inside, named_leaves
from emulator.scenes.scene import Scene
from emulator.surrogates.part import CachedPart, OfArrays, widened
from emulator.surrogates.taylor import monomials, rounded


class Warp(NamedTuple):
    """Features of a position: itself and polynomials of it, each divided by its length.

    centre : (p,). indices : (t, o) Taylor multi-indices. coefficients : (t, f).
    inverse_lengths : (p + f,).
    """

    centre: np.ndarray
    indices: np.ndarray
    coefficients: jax.Array
    inverse_lengths: jax.Array

    def __call__(self, position: jax.Array) -> jax.Array:
        """Features (p + f,) of ``position`` (p,)."""
        polynomials = monomials(self.indices, position - self.centre) @ self.coefficients
        return jnp.concatenate([position, polynomials]) * self.inverse_lengths

    def with_derivatives(self, positions: jax.Array) -> Features:
        """Features of ``positions`` (c, p) and their derivatives in position."""
        features: Callable[[jax.Array], jax.Array] = self.__call__
        return Features(jax.vmap(features)(positions), jax.vmap(jax.jacfwd(features))(positions))


@dataclass(frozen=True, eq=False)
class Discrepancy(OfArrays):
    """What to add to a map to meet FEM, a part of an emulator.

    warp : features of a position. known : (c, q) those of the runs.
    value_weights, derivative_weights : (c, r) and (c, q, r), from
        :func:`~emulator.core.gaussian_process.fold`.
    offset : (n, 3) mm. modes : (r, n, 3) mm.
    """

    warp: Warp
    known: jax.Array
    value_weights: jax.Array
    derivative_weights: jax.Array
    offset: jax.Array
    modes: jax.Array

    def coefficients(self, position: jax.Array) -> jax.Array:
        """Coefficients (r,) of the modes at ``position`` (p,) in the unit box.

        Raises
        ------
        InputError
            float64 is off. The weights of nearly equal runs are large and cancel: in float32 the
            shipped ventricle would be 9 mm off.
        """
        require_float64("a discrepancy model")
        return mean(self.warp(position), self.known, self.value_weights, self.derivative_weights)

    def __call__(self, position: jax.Array) -> jax.Array:
        """Displacement (n, 3) in mm to add at ``position`` (p,)."""
        return self.offset + jnp.tensordot(self.coefficients(position), self.modes, axes=1)

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """The model over ``nodes`` (k,)."""
        offset, modes = np.asarray(self.offset)[nodes], np.asarray(self.modes)[:, nodes]
        return CachedPart(offset, modes, self.coefficients)

    def arrays(self) -> dict[str, Any]:
        """All arrays by name, the warp's as ``warp/centre`` and so on."""
        return named_leaves({**vars(self), "warp": self.warp._asdict()})

    @classmethod
    def restore(
        cls, scene: Scene, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> Self:
        """The model with these arrays."""
        del scene, description
        stored = {name: widened(array) for name, array in arrays.items()}
        warp = inside(stored, "warp")
        coefficients, lengths = (
            jnp.asarray(warp[name]) for name in ("coefficients", "inverse_lengths")
        )
        names = ("known", "value_weights", "derivative_weights", "offset", "modes")
        return cls(
            Warp(warp["centre"], warp["indices"], coefficients, lengths),
            *(jnp.asarray(stored[name]) for name in names),
        )

    def rounded(self) -> Discrepancy:
        """The model with offset and modes in numbers float32 can hold, for a smaller file."""
        return replace(self, offset=rounded(self.offset), modes=rounded(self.modes))
