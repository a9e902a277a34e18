"""The sparsity pattern that all tangents of a mesh share, assembly into it, and its products."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# Relative increase of the diagonal, four units of round-off: an exactly zero pivot becomes tiny.
_RAISE = 2.0**-50
_EMPTY_ROW = 1e-290  # a row whose absolute sum is below this is empty
_ASYMMETRY = 1e-13  # of the largest entry: mirror images whose sums are rounded differently


@dataclass(frozen=True, eq=False)
class Pattern:
    """Nonzeros of a matrix over the free degrees of freedom, row by row, fixed for a mesh.

    rows, columns : the position of each nonzero, (nnz,) int32.
    source : the indices (k,) of the entries of the flattened element blocks that are used.
    target : the index (k,) of the nonzero to which each of these entries is added.
    size : the number of free degrees of freedom.
    upper : whether only the upper triangle of a symmetric matrix is stored.
    """

    rows: np.ndarray
    columns: np.ndarray
    source: np.ndarray
    target: np.ndarray
    size: int
    upper: bool = False

    def sum(self, entries: jax.Array) -> jax.Array:
        """Assemble values (nnz,) from the entries of all blocks, flattened one after the other."""
        return jax.ops.segment_sum(entries[self.source], self.target, num_segments=len(self.rows))

    @cached_property
    def _whole(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Row, column and stored index of every nonzero of both triangles, row by row."""
        above = np.flatnonzero(self.rows < self.columns)
        rows = np.concatenate([self.rows, self.columns[above]])
        columns = np.concatenate([self.columns, self.rows[above]])
        source = np.concatenate([np.arange(len(self.rows)), above])
        order = np.lexsort((columns, rows))
        return rows[order], columns[order], source[order]

    def both(self, values: jax.Array) -> tuple[np.ndarray, np.ndarray, jax.Array]:
        """Return rows, columns and values with both triangles."""
        if not self.upper:
            return self.rows, self.columns, values
        rows, columns, source = self._whole
        return rows, columns, values[source]

    @cached_property
    def half(self) -> Pattern:
        """The upper triangle of a pattern with both; its :meth:`sum` takes the values of both."""
        above = np.flatnonzero(self.rows <= self.columns).astype(np.int32)
        target = np.arange(len(above), dtype=np.int32)
        return Pattern(self.rows[above], self.columns[above], above, target, self.size, upper=True)

    @cached_property
    def _mirror(self) -> np.ndarray:
        """Index of every nonzero's mirror image, as nonzeros are sorted by row, then column."""
        return np.lexsort((self.rows, self.columns))

    def is_symmetric(self, values: jax.Array) -> jax.Array:
        """Return whether ``values`` of both triangles are mirror images, shape ()."""
        difference = jnp.max(jnp.abs(values - values[self._mirror]))
        return difference <= _ASYMMETRY * jnp.max(jnp.abs(values))

    def product(self, values: jax.Array, x: jax.Array) -> jax.Array:
        """Return ``A x`` for ``x`` of shape (size,) or (size, k)."""
        if x.ndim == 2:
            return jax.vmap(lambda column: self.product(values, column), 1, 1)(x)
        stored_part = jax.ops.segment_sum(
            values * x[self.columns], self.rows, num_segments=self.size, indices_are_sorted=True
        )
        if not self.upper:
            return stored_part
        above = jnp.where(self.rows < self.columns, values, 0.0)
        return stored_part.at[self.columns].add(above * x[self.rows])

    def solvable(self, values: jax.Array) -> jax.Array:
        """Return whether ``values`` are finite and leave no row empty, shape ()."""
        rows = jax.ops.segment_sum(jnp.abs(values), self.rows, num_segments=self.size)
        rows += jax.ops.segment_sum(jnp.abs(values), self.columns, num_segments=self.size)
        return jnp.all(jnp.isfinite(values)) & jnp.all(rows >= _EMPTY_ROW)

    def safe_values(self, values: jax.Array) -> jax.Array:
        """Return ``values`` (nnz,) to factorise: the identity's where ``values`` are not solvable.

        A pivot that is exactly zero leaves no solution. A diagonal larger by round-off makes the
        pivot tiny, and the step so long that Newton's method rejects it. Apply this once to each
        tangent (docs/experiments.md, "A tangent that was never the same").
        """
        diagonal = jnp.asarray(self.rows == self.columns, dtype=values.dtype)
        raised = values * (1.0 + _RAISE * diagonal)
        return jnp.where(self.solvable(values), raised, diagonal)


class Entries(NamedTuple):
    """Positions of the entries of dense blocks, in the order of the flattened blocks.

    rows, columns : the global degrees of freedom of each entry, (e,).
    mirrored : (e,) whether an entry of a symmetric block also stands for its mirror image, which
        the block does not store.
    spare : (e,) whether the mirror image of an entry is stored and stands for it.
    """

    rows: np.ndarray
    columns: np.ndarray
    mirrored: np.ndarray
    spare: np.ndarray


def whole_blocks(nodes: np.ndarray) -> Entries:
    """Return the entries of blocks (k, 3a, 3a) over the degrees of freedom of ``nodes`` (k, a)."""
    dofs = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
    shape = (*dofs.shape, dofs.shape[1])
    rows = np.broadcast_to(dofs[:, :, None], shape).ravel()
    columns = np.broadcast_to(dofs[:, None, :], shape).ravel()
    return Entries(rows, columns, np.zeros(len(rows), dtype=bool), rows > columns)


def upper_blocks(nodes: np.ndarray) -> Entries:
    """Return the entries of symmetric blocks (k, pairs, 3, 3) over the pairs of ``nodes`` (k, a).

    Each pair is stored once, in the order of ``np.triu_indices``.
    """
    one, other = np.triu_indices(nodes.shape[1])
    shape = (len(nodes), len(one), 3, 3)
    component = np.arange(3)
    rows = np.broadcast_to(3 * nodes[:, one, None, None] + component[:, None], shape).ravel()
    columns = np.broadcast_to(3 * nodes[:, other, None, None] + component, shape).ravel()
    mirrored = np.broadcast_to((one != other)[:, None, None], shape).ravel()
    return Entries(rows, columns, mirrored, ~mirrored & (rows > columns))


def block_pattern(groups: Sequence[Entries], free_index: np.ndarray, *, symmetric: bool) -> Pattern:
    """Return the pattern into which groups of dense blocks are assembled.

    groups : the entries of each group of blocks, in the order in which they are flattened.
    free_index : the position (n_dofs,) among the free degrees of freedom, -1 where prescribed.
    symmetric : whether to store only the upper triangle.
    """
    size = int(free_index.max()) + 1
    rows, columns, mirrored, spare = map(np.concatenate, zip(*groups, strict=True))
    rows, columns = free_index[rows], free_index[columns]
    source = np.flatnonzero((rows >= 0) & (columns >= 0) & ~(spare & symmetric))
    rows, columns = rows[source], columns[source]
    if symmetric:
        rows, columns = np.minimum(rows, columns), np.maximum(rows, columns)
    else:
        mirror = mirrored[source]
        source = np.concatenate([source, source[mirror]])
        rows, columns = (
            np.concatenate([rows, columns[mirror]]),
            np.concatenate([columns, rows[mirror]]),
        )
    keys, target = np.unique(rows * size + columns, return_inverse=True)
    return Pattern(
        rows=(keys // size).astype(np.int32),
        columns=(keys % size).astype(np.int32),
        source=source.astype(np.int32),
        target=target.astype(np.int32),
        size=size,
        upper=symmetric,
    )
