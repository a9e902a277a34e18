"""The multilayer perceptron that encoders, messages and decoders consist of."""

from __future__ import annotations

from functools import reduce
from itertools import pairwise

import jax
import jax.numpy as jnp
from flax import nnx


class MLP(nnx.Module):
    """Dense layers with CELU between them, on an input concatenated from several parts.

    The first layer is linear in each part, ``[a, b] @ W = a @ W_a + b @ W_b``, so a part shared by
    many rows (theta by all nodes, a node by all its edges) is multiplied once and the product
    copied: :meth:`project` each part, add, then :meth:`finish`.

    Parameters
    ----------
    parts : width of each part of the input.
    hidden : widths of the hidden layers.
    out : width of the output.
    layer_norm : normalise the output (encoders and processor; not decoders).
    zero_last : start the last layer at zero.
    """

    def __init__(
        self,
        parts: tuple[int, ...],
        hidden: tuple[int, ...],
        out: int,
        *,
        layer_norm: bool,
        zero_last: bool = False,
        rngs: nnx.Rngs,
    ) -> None:
        self.parts = parts
        widths = (sum(parts), *hidden, out)
        layers = [nnx.Linear(a, b, param_dtype=jnp.float32, rngs=rngs) for a, b in pairwise(widths)]
        if zero_last:
            layers[-1] = nnx.Linear(
                widths[-2],
                out,
                kernel_init=nnx.initializers.zeros_init(),
                param_dtype=jnp.float32,
                rngs=rngs,
            )
        self.layers = nnx.List(layers)
        self.norm = nnx.LayerNorm(out, param_dtype=jnp.float32, rngs=rngs) if layer_norm else None

    def project(self, part: int, values: jax.Array) -> jax.Array:
        """Contribution (..., hidden[0]) of part number ``part`` to the first layer."""
        start = sum(self.parts[:part])
        kernel = self.layers[0].kernel[start : start + self.parts[part]]
        return values.astype(kernel.dtype) @ kernel

    def finish(self, first: jax.Array) -> jax.Array:
        """The output (..., out) from the sum of all projections."""
        x = self._before(first, len(self.layers))
        return x if self.norm is None else self.norm(x)

    def hidden(self, *values: jax.Array) -> jax.Array:
        """What the last layer takes (..., hidden[-1]), from all parts."""
        return jax.nn.celu(self._before(self._first(values), len(self.layers) - 1))

    def _first(self, values: tuple[jax.Array, ...]) -> jax.Array:
        return reduce(jnp.add, (self.project(k, v) for k, v in enumerate(values)))

    def _before(self, first: jax.Array, stop: int) -> jax.Array:
        """Output of layer ``stop - 1`` from the sum of all projections."""
        bias = self.layers[0].bias
        x = first if bias is None else first + bias
        for layer in self.layers[1:stop]:
            x = layer(jax.nn.celu(x))
        return x

    def __call__(self, *values: jax.Array) -> jax.Array:
        """The output (..., out) from all parts."""
        return self.finish(self._first(values))
