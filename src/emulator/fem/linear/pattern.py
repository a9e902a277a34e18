"""The pattern that assembled tangents share, and its products."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

# Relative increase of the diagonal, four units of round-off: an exactly zero pivot becomes tiny.
_RAISE = 2.0**-50
_LEAST_ROW = 1e-290  # a row whose absolute sum is below this is empty


@dataclass(frozen=True, eq=False)
class Pattern:
    """Nonzeros of a matrix over the free degrees of freedom, fixed for a mesh.

    rows, columns : (nnz,) int32 position of each nonzero.
    source : (k,) indices of the entries of the flattened element blocks that are used.
    target : (k,) index of the nonzero that each of these entries is added to.
    size : number of free degrees of freedom.
    upper : whether only the upper triangle of a symmetric matrix is there.
    """

    rows: np.ndarray
    columns: np.ndarray
    source: np.ndarray
    target: np.ndarray
    size: int
    upper: bool = False

    def sum(self, entries: jax.Array) -> jax.Array:
        """Values (nnz,) from the entries of all blocks, flattened one after the other."""
        return jax.ops.segment_sum(entries[self.source], self.target, num_segments=len(self.rows))

    @cached_property
    def _whole(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Row, column and source of every nonzero of both triangles, row by row."""
        above = np.flatnonzero(self.rows < self.columns)
        rows = np.concatenate([self.rows, self.columns[above]])
        columns = np.concatenate([self.columns, self.rows[above]])
        source = np.concatenate([np.arange(len(self.rows)), above])
        order = np.lexsort((columns, rows))
        return rows[order], columns[order], source[order]

    def both(self, values: jax.Array) -> tuple[np.ndarray, np.ndarray, jax.Array]:
        """Rows, columns and values with both triangles."""
        if not self.upper:
            return self.rows, self.columns, values
        rows, columns, source = self._whole
        return rows, columns, values[source]

    def product(self, values: jax.Array, x: jax.Array) -> jax.Array:
        """``A x``, shape of ``x``: (size,) or (size, k)."""
        if x.ndim == 2:
            return jax.vmap(lambda column: self.product(values, column), 1, 1)(x)
        there = jax.ops.segment_sum(
            values * x[self.columns],
            self.rows,
            num_segments=self.size,
            indices_are_sorted=True,
        )
        if not self.upper:
            return there
        above = jnp.where(self.rows < self.columns, values, 0.0)
        return there.at[self.columns].add(above * x[self.rows])

    def solvable(self, values: jax.Array) -> jax.Array:
        """Whether ``values`` are finite and leave no row empty, shape ()."""
        rows = jax.ops.segment_sum(jnp.abs(values), self.rows, num_segments=self.size)
        rows += jax.ops.segment_sum(jnp.abs(values), self.columns, num_segments=self.size)
        return jnp.all(jnp.isfinite(values)) & jnp.all(rows >= _LEAST_ROW)

    def safe_values(self, values: jax.Array) -> jax.Array:
        """``values`` that UMFPACK does not raise on; the identity's where they are not solvable.

        UMFPACK raises on NaN, and on a pivot that is exactly zero. A diagonal larger by round-off
        makes such a pivot tiny instead, and the step so long that Newton's method rejects it. Apply
        once to each tangent (docs/experiments.md, "A tangent that was never the same").
        """
        diagonal = jnp.asarray(self.rows == self.columns, dtype=values.dtype)
        raised = values * (1.0 + _RAISE * diagonal)
        return jnp.where(self.solvable(values), raised, diagonal)


def block_pattern(groups: list[np.ndarray], free_index: np.ndarray, *, symmetric: bool) -> Pattern:
    """Pattern of dense blocks.

    Parameters
    ----------
    groups : each (k, d): global degrees of freedom of the rows, and columns, of k blocks.
    free_index : (n_dofs,) position among the free ones, -1 where held.
    symmetric : keep only the upper triangle.
    """
    size = int(free_index.max()) + 1
    pairs = [_block_entries(free_index[dofs]) for dofs in groups]
    rows, columns = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    keep = (rows >= 0) & (columns >= 0)
    if symmetric:
        keep &= rows <= columns
    source = np.flatnonzero(keep)
    keys, target = np.unique(rows[source] * size + columns[source], return_inverse=True)
    return Pattern(
        rows=(keys // size).astype(np.int32),
        columns=(keys % size).astype(np.int32),
        source=source.astype(np.int32),
        target=target.astype(np.int32),
        size=size,
        upper=symmetric,
    )


def _block_entries(dofs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of every entry of the blocks of ``dofs`` (k, d), flattened."""
    shape = (*dofs.shape, dofs.shape[1])
    rows = np.broadcast_to(dofs[:, :, None], shape).ravel()
    return rows, np.broadcast_to(dofs[:, None, :], shape).ravel()
