"""Where a solve starts: at the nearest theta solved so far."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from emulator.scenes.scene import Scene

Predictor = Callable[[jax.Array], jax.Array]
"""Maps a position in the unit box (p,) to a starting displacement (n, 3) mm."""


class Field(NamedTuple):
    """A converged solution: displacement (n, 3) mm; sensitivities (p, n, 3), or None."""

    displacement: Any
    sensitivities: Any


class Solved(Protocol):
    """The rows so far. ``thetas`` : of the whole design, (c, p)."""

    thetas: Any

    def converged(self) -> list[int]:
        """Numbers of the rows that did, in the order they were solved."""
        ...

    def field(self, number: int) -> Field:
        """The solution of a row that converged."""
        ...


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Starts of a solve: the solution at the nearest theta so far, that solution extrapolated along
    its sensitivities, and what ``predictor`` says.
    """  # noqa: D205

    scene: Scene
    solved: Solved
    predictor: Predictor | None = None

    def __call__(self, number: int) -> list[jax.Array]:
        """Displacements (n, 3) mm for the theta of that number."""
        position, starts = self._positions[number], list[jax.Array]()
        numbers = self.solved.converged()
        if numbers:
            steps = position - self._positions[numbers]
            near = int(np.argmin(np.sum(steps**2, axis=1)))
            starts += self._from(numbers[near], steps[near])
        if self.predictor is not None:
            starts.append(self.predictor(jnp.asarray(position)))
        return starts

    def _from(self, number: int, step: np.ndarray) -> list[jax.Array]:
        """The solution of a row, and extrapolated by ``step`` (p,) in the unit box."""
        there, slopes = self.solved.field(number)
        if slopes is None:
            return [there]
        return [there, there + jnp.tensordot(step * self._rates[number], slopes, axes=1)]

    @cached_property
    def _positions(self) -> np.ndarray:
        return np.asarray(self.scene.to_unit(jnp.asarray(self.solved.thetas)))

    @cached_property
    def _rates(self) -> np.ndarray:
        return np.asarray(self.scene.space.rates(jnp.asarray(self.solved.thetas)))
