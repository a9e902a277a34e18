"""Data without noise at many draws, by one program of a model's forward map.

Every program that has the forward map in it is compiled, and the map in most of them is most of
that time. So whatever asks for predictions at many draws and needs no derivative of them asks
:func:`means_at`: the check of data before they are taken, densities at points, log likelihoods and
replicated data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements import Observations
from calibrate.statistical_model.load_states import LoadStates
from emulator.core.kept import kept
from emulator.surrogates.corrected import CorrectedForward
from emulator.surrogates.fem import FEMForward
from emulator.surrogates.protocol import ForwardMap, Prediction

BLOCK = 256  # points evaluated by one call of a program, so that it is compiled for one shape
BATCH = 32  # points of a block that are vectorised


class Predicting(Protocol):
    """The part of :class:`~calibrate.statistical_model.Model` that predictions need."""

    @property
    def forward(self) -> ForwardMap:
        """The forward map of the observed nodes."""

    @property
    def observe(self) -> Observations:
        """The observations."""

    @property
    def states(self) -> LoadStates:
        """The unknowns of theta in each load state."""

    def predict_stacked(self, values: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        """Return data by observation, and their validity, from values (q,) of the unknowns."""

    def means(
        self, thetas: jax.Array, prediction: Prediction | None = None
    ) -> tuple[dict[str, jax.Array], jax.Array]:
        """Return the same from theta in every load state (S, p), and what is solved there."""


def batches(forward: ForwardMap) -> bool:
    """Say whether many evaluations at once are cheap, as they are where none solves FEM."""
    return not isinstance(forward, FEMForward | CorrectedForward)


def in_blocks(program: Callable[..., Any], *points: Any) -> Any:
    """Return ``program`` of arrays (s, ...), or trees of them, called with padded blocks."""
    count = len(jax.tree.leaves(points)[0])
    blocks = (
        jax.tree.map(lambda x, k=k: _padded(np.asarray(x[k : k + BLOCK])), points)
        for k in range(0, count, BLOCK)
    )
    parts = [jax.tree.map(np.asarray, program(*block)) for block in blocks]
    return jax.tree.map(lambda *arrays: np.concatenate(arrays)[:count], *parts)


def _padded(rows: np.ndarray) -> jax.Array:
    """Return rows (s, ...) and the last of them again, (BLOCK, ...)."""
    return jnp.asarray(np.concatenate([rows, np.repeat(rows[-1:], BLOCK - len(rows), axis=0)]))


def means_at(
    model: Predicting, draws: Mapping[str, Any]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return data without noise at draws, (s, *shape) by observation, and their validity (s,).

    Data are 0 where the forward map has no answer.

    draws : values (s,) of the unknowns by name; others are left alone.
    """
    columns = [np.asarray(draws[name]) for name in model.states.unknowns]
    return means_at_rows(model, np.stack(columns, axis=1))


def means_at_rows(model: Predicting, rows: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return :func:`means_at` values (s, q) of the unknowns, in their order."""
    parts = [_of_block(model, rows[k : k + BLOCK]) for k in range(0, len(rows), BLOCK)]
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)


def _of_block(model: Predicting, rows: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    if isinstance(model.forward, FEMForward):
        answers = _by_solves(model, model.forward, jnp.asarray(rows))
    else:
        answers = _program(model)(_padded(rows), -(-len(rows) // _batch(model)))
    return jax.tree.map(lambda values: np.asarray(values)[: len(rows)], answers)


def _batch(model: Predicting) -> int:
    return BATCH if batches(model.forward) else 1  # a solve waits for the longest of its batch


@kept
def _program(model: Predicting) -> Callable[[jax.Array, int], Any]:
    """Return the program of values (BLOCK, q) of the unknowns, and how many batches are wanted."""
    size = _batch(model)

    def block(values: jax.Array, wanted: jax.Array) -> Any:
        def batch(k: jax.Array, before: Any) -> Any:
            def put(all_rows: jax.Array, rows: jax.Array) -> jax.Array:
                return jax.lax.dynamic_update_slice_in_dim(all_rows, rows, k * size, 0)

            rows = jax.lax.dynamic_slice_in_dim(values, k * size, size)
            return jax.tree.map(put, before, jax.vmap(model.predict_stacked)(rows))

        shapes = model.observe.shapes
        means = {name: jnp.zeros((BLOCK, *shapes[name])) for name in model.observe.parts}
        return jax.lax.fori_loop(0, wanted, batch, (means, jnp.zeros(BLOCK, bool)))

    return jax.jit(block)


def _by_solves(model: Predicting, fem: FEMForward, rows: jax.Array) -> Any:
    """Return data and validity by solves that are driven from Python, all states of a row each."""
    of_states, of_solved = _around_solves(model)
    thetas = of_states(rows)
    solutions = fem.evaluate_all(thetas.reshape(-1, thetas.shape[-1]))
    shape = thetas.shape[:2]
    displacement = solutions.displacement.reshape(*shape, *solutions.displacement.shape[1:])
    return of_solved(thetas, displacement, jnp.all(solutions.valid.reshape(shape), axis=1))


@kept
def _around_solves(model: Predicting) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the programs of theta in every state (s, S, p), and of data from displacements."""
    unknowns = model.states.unknowns

    def thetas(values: jax.Array) -> jax.Array:
        return model.states.thetas(dict(zip(unknowns, values, strict=True)))

    def data(thetas: jax.Array, displacement: jax.Array, valid: jax.Array) -> Any:
        return model.means(thetas, Prediction(displacement, valid))

    return jax.jit(jax.vmap(thetas)), jax.jit(jax.vmap(data))
